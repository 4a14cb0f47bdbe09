"""Inpainting of masked pixels from their surroundings, and two filters beside it."""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor


def inpainted(images: Float[Tensor, "b c h w"], masked: Bool[Tensor, "b 1 h w"]) -> Float[Tensor, "b c h w"]:
    """Images whose masked pixels continue their surroundings.

    From coarse to fine: each level keeps its unmasked pixels and takes the others from the coarser level (pull-push,
    Gortler et al. 1996, "The Lumigraph").
    """
    known = (~masked).float()
    levels = [(images * known, known)]
    for _ in range(math.ceil(math.log2(max(images.shape[-2:])))):
        total, weight = (F.avg_pool2d(value, 2, ceil_mode=True) for value in levels[-1])
        levels.append((total, weight))
    total, weight = levels.pop()
    filled = total / weight.clamp(min=1e-6)
    for total, weight in reversed(levels):
        coarser = F.interpolate(filled, total.shape[-2:], mode="bilinear", align_corners=False)
        filled = torch.where(weight > 0, total / weight.clamp(min=1e-6), coarser)
    return filled


def dilated(mask: Float[Tensor, "b 1 h w"], pixels: int) -> Float[Tensor, "b 1 h w"]:
    """The largest value within so many pixels, across or down."""
    return F.max_pool2d(mask, 2 * pixels + 1, 1, pixels)


def blurred(images: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
    """Images behind a binomial filter of five pixels each way."""
    for axis in (-2, -1):
        padding = (0, 0, 2, 2) if axis == -2 else (2, 2, 0, 0)
        wide = F.pad(images, padding, mode="replicate")
        taps = [wide.narrow(axis, first, images.shape[axis]) for first in range(5)]
        images = (taps[0] + taps[4] + 4 * (taps[1] + taps[3]) + 6 * taps[2]) / 16
    return images
