"""How templates look at an object: viewpoints, crops, and distances, fixed before any template is drawn."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.networks.templates.trunk import COARSE_STRIDE

MAX_ROLL_DEG = 45.0
"""Largest angle by which cameras that look at an upright object are rolled, to either side."""

NUM_VIEWS, NUM_ROLLS = 220, 7
"""Directions on the upper hemisphere, about 10 degrees apart, and rolls of 15 degrees for each."""

LOCALISING_VIEWS, LOCALISING_ROLLS = 32, 4
"""A place is found with fewer."""

QUARTER_TURNS = 4
"""Rolls of an object that may stand in any way beyond :data:`MAX_ROLL_DEG`: by as many equal parts of a turn."""

CROP_PX, FILL = 128, 0.7
"""Side of a crop, and the fraction of it that the diameter spans."""

FRAME_STRIDE = 2
"""Frame pixels a pixel of the frame in which the object is localised."""

_LOG_DEPTH_STEP = 0.18
_GOLDEN_ANGLE = np.pi * (1 + 5**0.5)


@dataclass(frozen=True, eq=False)
class Geometry:
    """Frame, camera and object, from which the sizes of a template network follow."""

    matrix: np.ndarray
    """K of the frames, [3, 3]."""
    width: int
    """Width of the frames, pixels."""
    height: int
    """Height of the frames, pixels."""
    diameter_m: float
    """Diameter of the object."""
    near_m: float
    """Nearest distance of the object."""
    far_m: float
    """Farthest distance of the object."""
    any_side: bool = False
    """Whether the object is seen from all sides and rolled in any way, instead of from above and nearly upright."""

    @property
    def typical_m(self) -> float:
        """The distance that crop templates are drawn at: the middle of the range's logarithm."""
        return float(np.sqrt(self.near_m * self.far_m))

    @property
    def rotations(self) -> Float[Tensor, "templates 3 3"]:
        """Rotations that templates show; where an object may be rolled in any way, crops of it are rolled upright."""
        return viewpoints(num_views(self.any_side), NUM_ROLLS, self.any_side)

    @property
    def outline_rotations(self) -> Float[Tensor, "views 3 3"]:
        """One a direction, which rolls of the camera do not change."""
        return viewpoints(num_views(self.any_side), 1, self.any_side)

    @property
    def localising_rotations(self) -> Float[Tensor, "templates 3 3"]:
        """Rotations that templates for whole frames show."""
        if not self.any_side:
            return viewpoints(LOCALISING_VIEWS, LOCALISING_ROLLS)
        return viewpoints(2 * LOCALISING_VIEWS, QUARTER_TURNS * LOCALISING_ROLLS, True, QUARTER_TURNS * MAX_ROLL_DEG)

    @property
    def focal_px(self) -> float:
        """Focal length of the frames, pixels."""
        return float(self.matrix[0, 0])

    @property
    def depths_m(self) -> list[float]:
        """The distances that localising templates are drawn at."""
        span = np.log(self.far_m / self.near_m)
        count = max(1, round(span / _LOG_DEPTH_STEP))
        return [float(self.near_m * np.exp((number + 0.5) * span / count)) for number in range(count)]

    def kernel_cells(self, depth_m: float) -> int:
        """Side of a localising template in cells of stride 8, odd."""
        diameter_px = self.focal_px / FRAME_STRIDE * self.diameter_m / depth_m
        return 2 * int(np.ceil(diameter_px / 2 / COARSE_STRIDE)) + 1

    @property
    def frame_cells(self) -> tuple[int, int]:
        """Rows and columns of the feature map of a frame at stride 8."""
        stride = FRAME_STRIDE * COARSE_STRIDE
        return -(-self.height // stride), -(-self.width // stride)


def num_views(any_side: bool) -> int:
    """Directions of a bank of templates."""
    return 2 * NUM_VIEWS if any_side else NUM_VIEWS


def viewpoints(
    num_views: int, num_rolls: int, any_side: bool = False, max_roll_deg: float = MAX_ROLL_DEG
) -> Float[Tensor, "views*rolls 3 3"]:
    """Rotations cam_from_obj of cameras evenly spread over the upper hemisphere (object z up), each rolled.

    The directions are a Fibonacci lattice, over the whole sphere for an object that is seen from any side; rolls divide
    their range evenly.
    """
    number = np.arange(num_views) + 0.5
    height, azimuth = number / num_views, _GOLDEN_ANGLE * number
    height = 2 * height - 1 if any_side else height
    rolls = np.radians(max_roll_deg) * (2 * (np.arange(num_rolls) + 0.5) / num_rolls - 1)
    rotations = np.stack([looking(azimuth, height, roll) for roll in rolls], axis=1)
    return torch.from_numpy(rotations).flatten(0, 1).float()


def looking(
    azimuth: Float[np.ndarray, " views"],
    height: Float[np.ndarray, " views"],
    roll: float | Float[np.ndarray, "views 1"],
) -> Float[np.ndarray, "views 3 3"]:
    """Rotations cam_from_obj of cameras on a sphere around the object (z up) that look at its middle.

    Args:
        azimuth: Of the cameras, radians about z.
        height: Of the cameras on the unit sphere, −1 to 1.
        roll: Radians about the line of sight; one number for all, or one each.
    """
    level = np.sqrt(1 - height**2)
    forward = -np.stack([level * np.cos(azimuth), level * np.sin(azimuth), height], axis=1)
    right = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(len(azimuth))], axis=1)
    down = np.cross(forward, right)
    rows = [np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right, forward]
    return np.stack(rows, axis=1)
