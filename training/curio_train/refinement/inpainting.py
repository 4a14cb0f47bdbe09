"""Pictures without what is in front: hidden pixels continue what is around them."""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor


def filled_in(images: Float[Tensor, "b c h w"], hidden: Tensor) -> Float[Tensor, "b c h w"]:
    """Images whose hidden pixels [b, 1, h, w] continue what is around them.

    From coarse to fine: each level takes what it can see as it is and the rest from the level above it (pull-push,
    Gortler et al. 1996, "The Lumigraph").
    """
    seen = (~hidden).float()
    levels = [(images * seen, seen)]
    for _ in range(math.ceil(math.log2(max(images.shape[-2:])))):
        total, weight = (F.avg_pool2d(value, 2, ceil_mode=True) for value in levels[-1])
        levels.append((total, weight))
    total, weight = levels.pop()
    filled = total / weight.clamp(min=1e-6)
    for total, weight in reversed(levels):
        above = F.interpolate(filled, total.shape[-2:], mode="bilinear", align_corners=False)
        filled = torch.where(weight > 0, total / weight.clamp(min=1e-6), above)
    return filled


def grown(mask: Float[Tensor, "b 1 h w"], pixels: int) -> Float[Tensor, "b 1 h w"]:
    """The largest value within so many pixels, across or down."""
    return F.max_pool2d(mask, 2 * pixels + 1, 1, pixels)


def blurred(images: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
    """By a binomial filter of five pixels each way."""
    for axis in (-2, -1):
        padding = (0, 0, 2, 2) if axis == -2 else (2, 2, 0, 0)
        wide = F.pad(images, padding, mode="replicate")
        taps = [wide.narrow(axis, first, images.shape[axis]) for first in range(5)]
        images = (taps[0] + taps[4] + 4 * (taps[1] + taps[3]) + 6 * taps[2]) / 16
    return images
