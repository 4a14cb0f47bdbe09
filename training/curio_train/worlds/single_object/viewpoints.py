"""Drawing poses and lights of one object in six degrees of freedom, as a camera on a table's side sees it."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.geometry import rotation_between
from curio_train.rendering.materials import log_uniform
from curio_train.scene_code import Field

LARGEST_ROLL_DEG = 45.0
WEAKEST_LIGHT, STRONGEST_LIGHT = 0.2, 2.0
WEAKEST_KNOWN_LIGHT = 0.5
"""Where the scene is known: enough over the ambient light to tell one face from another, as a lamp or a window is."""
AMBIENT = 0.4


@dataclass(frozen=True)
class Exposure:
    """What an object's own colours may be multiplied by.

    Attributes:
        darkest: Least factor.
        brightest: Largest; those between are log-uniform.
        tint: Standard deviation of the logarithm of what each channel is multiplied by beside that.
    """

    darkest: float
    brightest: float
    tint: float


ANY_EXPOSURE = Exposure(0.3, 1.25, 0.2)
MILD_EXPOSURE = Exposure(0.5, 1.25, 0.08)
"""Where the scene is known, or colour is what an object is found by."""


def upper_views(count: int, random: np.random.Generator) -> Float[Tensor, "count 3 3"]:
    """Rotations cam_from_obj of cameras on the upper hemisphere (object z up) that look at the object, rolled."""
    azimuth = random.uniform(0, 2 * np.pi, count)
    height = random.uniform(0, 1, count)  # of the camera on the unit sphere: uniform there is uniform in area
    level = np.sqrt(1 - height**2)
    forward = -np.stack([level * np.cos(azimuth), level * np.sin(azimuth), height], axis=1)
    right = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(count)], axis=1)
    down = np.cross(forward, right)
    roll = np.radians(random.uniform(-LARGEST_ROLL_DEG, LARGEST_ROLL_DEG, count))[:, None]
    rows = [np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right, forward]
    return torch.from_numpy(np.stack(rows, axis=1)).float()


def turned_towards(
    translation: Float[Tensor, "count 3"], rotation: Float[Tensor, "count 3 3"]
) -> Float[Tensor, "count 3 3"]:
    """Rotations of objects seen along the optical axis, carried to where they are in the frame."""
    axis = translation.new_tensor([0.0, 0.0, 1.0]).expand_as(translation)
    return rotation_between(axis, translation) @ rotation


def places(field: Field, count: int, random: np.random.Generator) -> Float[Tensor, "count 3"]:
    """Positions uniform in a perspective field's range: in (x/z, y/z, z)."""
    position = random.uniform(field.lower, field.upper, (count, 3))
    position[:, :2] *= position[:, 2:]
    return torch.from_numpy(position).float()


def lights(count: int, random: np.random.Generator, weakest: float) -> Float[Tensor, "count 3"]:
    """Light from the camera's half space: towards it, camera frame; its length is the strength, log-uniform."""
    direction = random.normal(size=(count, 3))
    direction[:, 2] = -np.abs(direction[:, 2])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return torch.from_numpy(direction * log_uniform(weakest, STRONGEST_LIGHT, (count, 1), random)).float()


def exposures(count: int, random: np.random.Generator, most: Exposure) -> Float[Tensor, "count 1 3"]:
    """What an object's colours are multiplied by, as if it stood in more or less, and warmer or colder, light."""
    tint = np.exp(most.tint * random.normal(size=(count, 1, 3)))
    return torch.from_numpy(log_uniform(most.darkest, most.brightest, (count, 1, 1), random) * tint).float()
