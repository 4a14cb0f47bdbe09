"""What a user may choose about each world, as plain data without torch: the command line's flags."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from curio_train.config import WorldOptions


@dataclass(frozen=True)
class CirclesOptions(WorldOptions):
    """A red circle of constant size on black: 2D position alone. Needs no data."""


@dataclass(frozen=True)
class LinemodOptions(WorldOptions):
    """One object of the LineMOD data set in six degrees of freedom, over cluttered backgrounds.

    Attributes:
        class_name: ape, benchvise, can, cat, …: the object.
        data: Folder in BOP's layout (lm or lmo) with models, models_info.json and camera.json.
        backgrounds: Folder of photographs to see the object in front of; clutter is rendered where none is given.
    """

    class_name: Annotated[str, tyro.conf.arg(name="class")]
    data: Path
    backgrounds: Path | None = None
