"""Random scenes: positions that keep objects apart, colours, yaws, presence and the sun."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

MIN_SATURATION, MIN_VALUE = 0.5, 0.7
"""Least saturation and value of drawn colours; backgrounds are black or grey."""

_MAX_ROUNDS = 2000


def separate_positions(
    count: int,
    radii_m: Sequence[float],
    lower: Sequence[float],
    upper: Sequence[float],
    random: np.random.Generator,
    allowed: Callable[[np.ndarray], np.ndarray] = lambda points: np.ones(len(points), dtype=bool),
) -> Tensor:
    """Positions by rejection, object by object: each is drawn anew until it touches no earlier one.

    Args:
        count: Number of scenes.
        radii_m: Of a sphere round each object, or of a vertical cylinder if the box is flat.
        lower: Corner of the box in which positions are uniform.
        upper: The opposite corner.
        random: Source of the draws.
        allowed: Which of the points [n, 3] in the box are allowed.

    Returns:
        [count, num_objects, 3] metres; no two objects of a scene are closer than the sum of their radii, unless there
        is no room for so many.
    """
    radii = np.asarray(radii_m)
    found = np.zeros((count, len(radii), 3))
    for number, radius in enumerate(radii):
        pending, rounds = np.arange(count), 0
        while len(pending) and rounds < _MAX_ROUNDS:
            found[pending, number] = random.uniform(lower, upper, (len(pending), 3))
            distance = np.linalg.norm(found[pending, :number] - found[pending, number, None], axis=-1)
            touching = (distance < radii[:number] + radius).any(axis=1)
            pending, rounds = pending[touching | ~allowed(found[pending, number])], rounds + 1
    return torch.from_numpy(found).float()


def random_colors(
    count: int,
    num_objects: int,
    random: np.random.Generator,
    min_saturation: float = MIN_SATURATION,
    min_value: float = MIN_VALUE,
) -> Tensor:
    """Colours [count, num_objects, 3] in sRGB, uniform in hue, saturation and value."""
    hue = random.uniform(0, 6, (count, num_objects, 1))
    saturation = random.uniform(min_saturation, 1, hue.shape)
    value = random.uniform(min_value, 1, hue.shape)
    # Each channel is full over a third of the colour circle, absent over another, and ramps in between.
    ramp = (np.abs((hue - np.array([0, 2, 4]) + 3) % 6 - 3) - 1).clip(0, 1)
    return torch.from_numpy(value * (1 - saturation * ramp)).float()


def random_yaws(count: int, num_objects: int, random: np.random.Generator) -> Tensor:
    """(i, j) [count, num_objects, 2] of uniform angles, of length 1."""
    angle = random.uniform(-np.pi, np.pi, (count, num_objects))
    return torch.from_numpy(np.stack([np.cos(angle), np.sin(angle)], axis=-1)).float()


def random_presence(count: int, num_objects: int, minimum: int, random: np.random.Generator) -> Tensor:
    """1 for objects that are present, else 0, [count, num_objects, 1]; numbers from ``minimum`` on are equally likely.

    Which objects are present is random, so all slots are used equally often.
    """
    number = random.integers(minimum, num_objects + 1, (count, 1))
    rank = random.random((count, num_objects)).argsort(axis=1).argsort(axis=1)
    return torch.from_numpy(rank < number).float()[..., None]


def random_suns(count: int, lowest_deg: float, highest_deg: float, random: np.random.Generator) -> Tensor:
    """(x / y, z / y) [count, 2] of directions uniform on the unit sphere between two elevations."""
    lowest, highest = (float(np.sin(np.radians(degrees))) for degrees in (lowest_deg, highest_deg))
    height = random.uniform(lowest, highest, count)  # uniform in height is uniform in area
    azimuth = random.uniform(-np.pi, np.pi, count)
    slope = np.sqrt(1 - height**2) / height
    return torch.from_numpy(np.stack([slope * np.cos(azimuth), slope * np.sin(azimuth)], axis=1)).float()
