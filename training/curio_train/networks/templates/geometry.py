"""How templates look at an object: viewpoints, crops, and distances, fixed before any template is drawn."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.networks.templates.trunk import COARSE_STRIDE

MAX_ROLL_DEG = 45.0
"""By which cameras that look at an upright object are rolled, to either side."""

NUM_VIEWS, NUM_ROLLS = 220, 7
"""Directions on the upper hemisphere, about 10 degrees apart, and rolls of 15 degrees for each."""

LOCALISING_VIEWS, LOCALISING_ROLLS = 32, 4
"""A place is found with fewer."""

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
    """Of the frames, pixels."""
    height: int
    """Of the frames, pixels."""
    diameter_m: float
    """Of the object."""
    near_m: float
    """Nearest distance of the object."""
    far_m: float
    """Farthest."""

    @property
    def typical_m(self) -> float:
        """The distance that crop templates are drawn at: the middle of the range's logarithm."""
        return float(np.sqrt(self.near_m * self.far_m))

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


def viewpoints(num_views: int, num_rolls: int) -> Float[Tensor, "views*rolls 3 3"]:
    """Rotations cam_from_obj of cameras evenly spread over the upper hemisphere (object z up), each rolled.

    The directions are a Fibonacci lattice; rolls divide the range of the training views evenly.
    """
    number = np.arange(num_views) + 0.5
    height, azimuth = number / num_views, _GOLDEN_ANGLE * number
    level = np.sqrt(1 - height**2)
    forward = -np.stack([level * np.cos(azimuth), level * np.sin(azimuth), height], axis=1)
    right = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(num_views)], axis=1)
    down = np.cross(forward, right)
    rolls = np.radians(MAX_ROLL_DEG) * (2 * (np.arange(num_rolls) + 0.5) / num_rolls - 1)
    rotations = [
        np.stack(
            [np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right, forward], axis=1
        )
        for roll in rolls
    ]
    return torch.from_numpy(np.stack(rotations, axis=1)).flatten(0, 1).float()
