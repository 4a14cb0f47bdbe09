"""What a user may choose about each world, as plain data without torch: the command line's flags."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import tyro

from curio_train.config import Method, WorldOptions
from curio_train.errors import UsageError

_GAZE_RECIPE: Mapping[str, Any] = {
    "matrix_learning_rate": 0.01,
    "learning_rate": 1e-3,
    "warm_up_steps": 100,
    "gradient_clip": 1.0,
    "budget_images": 240_000,
}


def _make_absolute(options: WorldOptions, *names: str) -> None:
    """A run is evaluated and exported from other folders than it was started in."""
    for name in names:
        if isinstance(path := getattr(options, name), Path):
            object.__setattr__(options, name, path.absolute())


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
        download: Without --data, fetch LineMOD from BOP's repository into the cache folder, once; some gigabytes.
        backgrounds: Folder of photographs to see the object in front of; clutter is rendered where none is given.
        gaze: Look twice: at the whole frame for the place, at a crop around it for the rest. Without, the paper's one
            encoder sees the frame squeezed to 128x128.
    """

    default_method: ClassVar[Method] = "sleep"
    default_recipe: ClassVar[Mapping[str, Any]] = _GAZE_RECIPE

    class_name: Annotated[str, tyro.conf.arg(name="class")]
    data: Path | None = None
    backgrounds: Path | None = None
    gaze: tyro.conf.FlagCreatePairsOff[bool] | bool = True
    download: tyro.conf.FlagCreatePairsOff[bool] = False

    def __post_init__(self) -> None:
        """Make paths absolute."""
        _make_absolute(self, "data", "backgrounds")


@dataclass(frozen=True)
class CaptureOptions(WorldOptions):
    """A part of your own, from its CAD file, in six degrees of freedom. With --calibrate: find out its camera instead.

    Attributes:
        mesh: Mesh file: STL, OBJ, PLY, GLB, glTF or OFF. Without colours it is learned in any colour.
        camera: Camera file of the photographs: camera JSON, or BOP's camera.json.
        photos: Folder of unlabelled photographs. They are checked against the camera, and the report shows what was
            found in them; nothing is learned from them yet.
        mesh_unit: Unit of the mesh file's coordinates; the file's own, or metres, unless given.
        background: Photograph of the empty scene, taken as the others were.
        backgrounds: Folder of photographs to see the part in front of, where the scene changes; clutter is rendered
            where neither is given.
        near_m: Least distance of the part's origin along the optical axis, metres.
        far_m: Largest.
        upright: The part is only seen from above (z of the mesh is up, rolled by up to 45 degrees), not from any side.
    """

    default_method: ClassVar[Method] = "sleep"
    default_recipe: ClassVar[Mapping[str, Any]] = _GAZE_RECIPE

    mesh: Path
    camera: Path
    photos: Path
    mesh_unit: Literal["m", "cm", "mm", "inch"] | None = None
    background: Path | None = None
    backgrounds: Path | None = None
    near_m: float = 0.3
    far_m: float = 1.0
    upright: tyro.conf.FlagCreatePairsOff[bool] = False

    def __post_init__(self) -> None:
        """Make paths absolute, and refuse what contradicts itself."""
        _make_absolute(self, "mesh", "camera", "photos", "background", "backgrounds")
        if self.background is not None and self.backgrounds is not None:
            raise UsageError("--background and --backgrounds exclude each other: a plate, or a folder of other scenes")
        if not 0 < self.near_m < self.far_m:
            raise UsageError(
                f"found --near-m {self.near_m:g} and --far-m {self.far_m:g}, expected 0 < near < far, in metres"
            )
