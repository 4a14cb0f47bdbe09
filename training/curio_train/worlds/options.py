"""What a user may choose about each world, as plain data without torch: the command line's flags."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import tyro

from curio_train.config import Method, NetworkConfig, WorldOptions


@dataclass(frozen=True)
class CirclesOptions(WorldOptions):
    """A red circle of constant size on black: 2D position alone. Needs no data."""


@dataclass(frozen=True)
class SpheresOptions(WorldOptions):
    """Three spheres on black: 3D position and colour of each. Needs no data."""


@dataclass(frozen=True)
class ChairsOptions(WorldOptions):
    """Five chairs on the ground: position and yaw of each. Needs no data."""


@dataclass(frozen=True)
class VariedOptions(WorldOptions):
    """Two to five spheres on black: position, colour and confidence of each. Needs no data."""


@dataclass(frozen=True)
class MultiOptions(WorldOptions):
    """Two each of the letters W, X, Y, Z on the ground: position, yaw and colour of each. Needs no data."""


@dataclass(frozen=True)
class LightOptions(WorldOptions):
    """Two to ten capsules, boxes and cones on the ground: all of the above, and where the sun is. Needs no data."""


@dataclass(frozen=True)
class LinemodOptions(WorldOptions):
    """One object of the LineMOD data set in six degrees of freedom, over cluttered backgrounds.

    Attributes:
        class_name: ape, benchvise, can, cat, …: the object.
        data: Folder in BOP's layout (lm or lmo) with models, models_info.json and camera.json.
        backgrounds: Folder of photographs to see the object in front of; clutter is rendered where none is given.
    """

    default_method: ClassVar[Method] = "sleep"
    default_network: ClassVar[NetworkConfig] = NetworkConfig(reading="attention")

    class_name: Annotated[str, tyro.conf.arg(name="class")]
    data: Path
    backgrounds: Path | None = None

    def __post_init__(self) -> None:
        """Make paths absolute: a run is evaluated and exported from other folders than it was started in."""
        for name in ("data", "backgrounds"):
            if isinstance(path := getattr(self, name), Path):
                object.__setattr__(self, name, path.absolute())
