"""Base-colour priors of unpainted objects: any colour, or colours near one that photographs or the user name."""

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.worlds.placement import random_colors

BaseColorPrior = Callable[[int, np.random.Generator], Float[Tensor, "count 1 3"]]
"""Draws sRGB base colours."""

MIDDLE_GREY = (0.5, 0.5, 0.5)
"""SRGB: stands for a colour that nobody knows."""

MIN_BASE_VALUE = 0.1
"""HSV value of base colours; their saturation may be anything: black, white, grey or any colour between."""

ANY_COLOR_FRACTION = 0.15
"""Fraction of images in which the object has any colour, so that a wrong named colour is not fatal."""

_MIN_FACTOR, _MAX_FACTOR = 0.6, 1.5  # of the value, because the light's strength is unknown
_MIN_NEAR_VALUE = 0.05
_TINT = 0.06  # standard deviation of each channel, relative to the largest: coloured light, white balance


def any_base_color(count: int, random: np.random.Generator) -> Float[Tensor, "count 1 3"]:
    """Base colours of an object of which nothing is known."""
    return random_colors(count, 1, random, 0.0, MIN_BASE_VALUE)


def base_colors_near(srgb: tuple[float, float, float]) -> BaseColorPrior:
    """The prior around a colour in [0, 1]."""
    return partial(_base_colors, np.array(srgb))


def _base_colors(srgb: np.ndarray, count: int, random: np.random.Generator) -> Tensor:
    value = max(float(srgb.max()), _MIN_NEAR_VALUE)
    tints = srgb / value + _TINT * random.normal(size=(count, 1, 3))
    factors = np.exp(random.uniform(np.log(_MIN_FACTOR), np.log(_MAX_FACTOR), (count, 1, 1)))
    near = torch.from_numpy(tints.clip(0, 1) * (value * factors).clip(_MIN_NEAR_VALUE, 1)).float()
    is_any = torch.from_numpy(random.random((count, 1, 1)) < ANY_COLOR_FRACTION)
    return torch.where(is_any, any_base_color(count, random), near)
