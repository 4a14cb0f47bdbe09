"""Colours drawn for an unpainted part of which photographs, or the user, say what colour it has."""

from functools import partial

import numpy as np
import torch
from torch import Tensor

from curio_train.errors import UsageError
from curio_train.worlds.single_object.world import BaseColorPrior, any_base_color

ANY_SHARE = 0.15
"""Of images in which the part has any colour, so that a colour that was wrongly found is not fatal."""

_LEAST_FACTOR, _LARGEST_FACTOR = 0.6, 1.5  # of the value: how strong the light is remains unknown
_LEAST_VALUE = 0.05
_TINT = 0.06  # standard deviation of each channel, as a share of the largest: light of other things, white balance


def base_colors_near(color: str) -> BaseColorPrior:
    """Draws colours about one given as #rrggbb, sRGB.

    Raises:
        UsageError: It is not written so.
    """
    digits = color.removeprefix("#")
    try:
        channels = bytes.fromhex(digits)
    except ValueError:
        channels = b""
    if len(channels) != 3 or len(digits) != 6:
        raise UsageError(f"--paint {color}: expected a colour in sRGB such as '#8a6f4c'")
    return partial(_paints, np.frombuffer(channels, np.uint8) / 255)


def _paints(srgb: np.ndarray, count: int, random: np.random.Generator) -> Tensor:
    value = max(float(srgb.max()), _LEAST_VALUE)
    tints = srgb / value + _TINT * random.normal(size=(count, 1, 3))
    factors = np.exp(random.uniform(np.log(_LEAST_FACTOR), np.log(_LARGEST_FACTOR), (count, 1, 1)))
    near = torch.from_numpy(tints.clip(0, 1) * (value * factors).clip(_LEAST_VALUE, 1)).float()
    anything = torch.from_numpy(random.random((count, 1, 1)) < ANY_SHARE)
    return torch.where(anything, any_base_color(count, random), near)
