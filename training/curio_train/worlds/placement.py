"""Drawing scenes: places that keep objects apart, colours, presence."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

LEAST_SATURATION, LEAST_VALUE = 0.5, 0.7
"""Of drawn colours; black and grey are left to what is behind the objects."""

_MOST_ROUNDS = 2000


def places(
    count: int,
    radii_m: Sequence[float],
    lower: Sequence[float],
    upper: Sequence[float],
    random: np.random.Generator,
    allowed: Callable[[np.ndarray], np.ndarray] = lambda points: np.ones(len(points), dtype=bool),
) -> Tensor:
    """Positions by rejection, one object after the other: each is drawn anew until it touches none before it.

    Args:
        count: Number of scenes.
        radii_m: Of a sphere round each object, or of a vertical cylinder where the box is flat.
        lower: Corner of the box that positions are uniform in.
        upper: The opposite corner.
        random: Source of the draws.
        allowed: Which of the points [n, 3] are places at all, in a box that is not.

    Returns:
        [count, num_objects, 3] metres; no two objects of a scene are closer than the sum of their radii, unless there
        is no room for so many.
    """
    radii = np.asarray(radii_m)
    found = np.zeros((count, len(radii), 3))
    for number, radius in enumerate(radii):
        waiting, rounds = np.arange(count), 0
        while len(waiting) and rounds < _MOST_ROUNDS:
            found[waiting, number] = random.uniform(lower, upper, (len(waiting), 3))
            distance = np.linalg.norm(found[waiting, :number] - found[waiting, number, None], axis=-1)
            touching = (distance < radii[:number] + radius).any(axis=1)
            waiting, rounds = waiting[touching | ~allowed(found[waiting, number])], rounds + 1
    return torch.from_numpy(found).float()


def colors(
    count: int,
    num_objects: int,
    random: np.random.Generator,
    least_saturation: float = LEAST_SATURATION,
    least_value: float = LEAST_VALUE,
) -> Tensor:
    """Colours [count, num_objects, 3] in sRGB, uniform in hue, saturation and value."""
    hue = random.uniform(0, 6, (count, num_objects, 1))
    saturation = random.uniform(least_saturation, 1, hue.shape)
    value = random.uniform(least_value, 1, hue.shape)
    # Each channel is full over a third of the colour circle, absent over another, and ramps in between.
    ramp = (np.abs((hue - np.array([0, 2, 4]) + 3) % 6 - 3) - 1).clip(0, 1)
    return torch.from_numpy(value * (1 - saturation * ramp)).float()


def yaws(count: int, num_objects: int, random: np.random.Generator) -> Tensor:
    """(i, j) [count, num_objects, 2] of uniform angles, of length 1."""
    angle = random.uniform(-np.pi, np.pi, (count, num_objects))
    return torch.from_numpy(np.stack([np.cos(angle), np.sin(angle)], axis=-1)).float()


def presence(count: int, num_objects: int, least: int, random: np.random.Generator) -> Tensor:
    """1 for what is there and 0 for what is not, [count, num_objects, 1]; each number from ``least`` is as likely.

    Which objects they are is left to chance, so that each slot is as often used as any other.
    """
    number = random.integers(least, num_objects + 1, (count, 1))
    rank = random.random((count, num_objects)).argsort(axis=1).argsort(axis=1)
    return torch.from_numpy(rank < number).float()[..., None]
