"""Frames as cameras see them that are turned and zoomed a little, so that a network learns each from many sides."""

import numpy as np
import torch
from curio_serve.imaging.virtual_cameras import VirtualCamera
from jaxtyping import Float, UInt8
from torch import Tensor

from curio_train.networks.crop_camera import about_axis

LARGEST_ROLL_DEG = 20.0
"""Largest angle by which cameras are rolled, to either side."""

_LARGEST_PAN_DEG, _LARGEST_TILT_DEG = 6.0, 5.0
_LARGEST_LOG_ZOOM = 0.18


def random_camera(random: np.random.Generator) -> VirtualCamera:
    """A camera at the place of the real one."""
    return VirtualCamera(
        roll_deg=random.uniform(-LARGEST_ROLL_DEG, LARGEST_ROLL_DEG),
        zoom=float(np.exp(random.uniform(-_LARGEST_LOG_ZOOM, _LARGEST_LOG_ZOOM))),
        pan_deg=random.uniform(-_LARGEST_PAN_DEG, _LARGEST_PAN_DEG),
        tilt_deg=random.uniform(-_LARGEST_TILT_DEG, _LARGEST_TILT_DEG),
    )


def random_rolls(
    count: int, random: np.random.Generator, largest_deg: float = LARGEST_ROLL_DEG
) -> Float[Tensor, "count 3 3"]:
    """Random rotations about the optical axis, by which cameras of crops are rolled."""
    roll = torch.from_numpy(np.radians(random.uniform(-largest_deg, largest_deg, count))).float()
    return about_axis(torch.stack([roll.cos(), roll.sin()], dim=1))


def seen_by(
    camera: VirtualCamera,
    frame: UInt8[Tensor, "3 height width"],
    matrix: Float[np.ndarray, "3 3"],
    position_m: Float[np.ndarray, "objects 3"],
) -> tuple[Float[Tensor, "3 height width"], Float[np.ndarray, "objects 3"]]:
    """A frame, in [0, 1], and where it shows objects, in metres and in that camera's frame.

    Args:
        camera: That sees.
        frame: Of the real camera.
        matrix: K of both.
        position_m: Of the objects in the real camera's frame; NaN stays NaN.
    """
    pixels = camera.image(frame.permute(1, 2, 0).numpy(), matrix)
    turned_m = position_m @ camera.virtual_from_cam.T / (1.0, 1.0, camera.zoom)
    return torch.from_numpy(pixels).permute(2, 0, 1).float() / 255, turned_m
