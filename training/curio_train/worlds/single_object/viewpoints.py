"""Random poses, lights and exposures of one object in six degrees of freedom."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.geometry import rotation_between
from curio_train.networks.templates.geometry import MAX_ROLL_DEG, looking
from curio_train.rendering.materials import log_uniform
from curio_train.scene_code import Field

MIN_LIGHT, MAX_LIGHT = 0.2, 2.0
MIN_LIGHT_OF_KNOWN_SCENE = 0.5
"""Strong enough over the ambient light to tell one face from another, as a lamp or a window is."""
AMBIENT = 0.4


@dataclass(frozen=True)
class Exposure:
    """Range of the factors on an object's own colours."""

    darkest: float
    """Smallest factor."""
    brightest: float
    """Largest; factors are log-uniform."""
    tint: float
    """Standard deviation of the logarithm of an additional factor on each channel."""


ANY_EXPOSURE = Exposure(0.3, 1.25, 0.2)
MILD_EXPOSURE = Exposure(0.5, 1.25, 0.08)
"""Range where the scene is known, or where the object is found by its colour."""


def upper_hemisphere_rotations(count: int, random: np.random.Generator) -> Float[Tensor, "count 3 3"]:
    """Rotations cam_from_obj of cameras on the upper hemisphere (object z up) that look at the object, rolled."""
    azimuth = random.uniform(0, 2 * np.pi, count)
    height = random.uniform(0, 1, count)  # of the camera on the unit sphere: uniform in height is uniform in area
    roll = np.radians(random.uniform(-MAX_ROLL_DEG, MAX_ROLL_DEG, count))[:, None]
    return torch.from_numpy(looking(azimuth, height, roll)).float()


def allocentric_to_egocentric(
    translation_m: Float[Tensor, "count 3"], rotation: Float[Tensor, "count 3 3"]
) -> Float[Tensor, "count 3 3"]:
    """Rotations cam_from_obj of objects that look, along their own rays, as ``rotation`` does on the optical axis."""
    axis = translation_m.new_tensor([0.0, 0.0, 1.0]).expand_as(translation_m)
    return rotation_between(axis, translation_m) @ rotation


def random_positions(field: Field, count: int, random: np.random.Generator) -> Float[Tensor, "count 3"]:
    """Positions [n, 3], drawn uniformly in (x/z, y/z, z) over a perspective field's range."""
    position = random.uniform(field.lower, field.upper, (count, 3))
    position[:, :2] *= position[:, 2:]
    return torch.from_numpy(position).float()


def random_lights(count: int, random: np.random.Generator, min_strength: float) -> Float[Tensor, "count 3"]:
    """Light from the camera's half space: towards it, camera frame; its length is the strength, log-uniform."""
    direction = random.normal(size=(count, 3))
    direction[:, 2] = -np.abs(direction[:, 2])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return torch.from_numpy(direction * log_uniform(min_strength, MAX_LIGHT, (count, 1), random)).float()


def random_exposures(count: int, random: np.random.Generator, exposure: Exposure) -> Float[Tensor, "count 1 3"]:
    """Factors on an object's colours, as if it stood in more or less, and warmer or colder, light."""
    tint = np.exp(exposure.tint * random.normal(size=(count, 1, 3)))
    return torch.from_numpy(log_uniform(exposure.darkest, exposure.brightest, (count, 1, 1), random) * tint).float()
