"""What lies between a rendering and a photograph: light, exposure, colour, blur, noise, things in front (torch)."""

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

LARGEST_OCCLUDER = 0.35  # of the image's side
_SHADE_CELLS = (2, 5)  # of uneven light's grid, a side: from a gradient over the image to shadows of a third of it
_DARKEST, _LEAST = float(np.log(1e-4)), 1e-30  # values below are as black as that; the logarithm of black is finite
_NOISE_STARTS = 2**20
_VALUES_AT_ONCE = 2**17  # half a megabyte: what lies between two operations stays in the cache of a core


@dataclass(frozen=True)
class AugmentationStrength:
    """Ranges of the augmentation; each picture draws its own strengths from them, uniformly."""

    occluded: float
    """Fraction of the images with something in front."""
    shade: float
    """Largest standard deviation of the logarithm of uneven light."""
    gamma: float
    """Largest logarithm, up or down, of the exponent on values."""
    saturation: tuple[float, float]
    """Least and largest factor on colours' difference from grey."""
    exposure: tuple[float, float]
    """Least and largest factor on values."""
    tint: float
    """Largest fraction by which a channel is lighter or darker than that."""
    contrast: tuple[float, float]
    """Least and largest factor on values' difference from their mean."""
    offset: float
    """Largest constant that is added to all values, or subtracted from them, after the contrast."""
    blur: float
    """Largest weight of the image behind a Gaussian of one pixel, beside the sharp one."""
    noise: float
    """Largest standard deviation."""


UNKNOWN_SCENE = AugmentationStrength(
    occluded=0.5,
    shade=0.45,
    gamma=0.35,
    saturation=(0.3, 1.6),
    exposure=(0.5, 1.5),
    tint=0.15,
    contrast=(0.6, 1.3),
    offset=0.1,
    blur=1.0,
    noise=0.05,
)
"""Any camera, any light: colours hardly count, shapes do."""

WHOLE_FRAME = AugmentationStrength(
    occluded=0.5,
    shade=0.25,
    gamma=0.2,
    saturation=(0.7, 1.3),
    exposure=(0.7, 1.3),
    tint=0.08,
    contrast=(0.8, 1.2),
    offset=0.1,
    blur=1.0,
    noise=0.05,
)
"""Strength for whole frames: an object is a few pixels in clutter, and its colour tells it from other things."""

KNOWN_SCENE = AugmentationStrength(
    occluded=0.25,
    shade=0.15,
    gamma=0.1,
    saturation=(0.8, 1.2),
    exposure=(0.8, 1.2),
    tint=0.05,
    contrast=(0.85, 1.15),
    offset=0.05,
    blur=1.0,
    noise=0.03,
)
"""One camera before a scene whose picture is there: light drifts and something is put down now and then."""


class _Drawn(NamedTuple):
    """The strengths drawn for each image; the first axis of each tensor is the batch."""

    light: Tensor  # [batch, 1, height, width], a logarithm
    exponent: Tensor  # [batch, 1, 1, 1]
    mixing: Tensor  # [batch, 3, 3], of channels
    contrast: Tensor  # [batch, 1, 1]
    offset: Tensor  # [batch, 1, 1]
    blur: Tensor  # [batch, 1, 1, 1]
    noise: Tensor  # [batch, 1, 1, 1]
    noise_start: Tensor  # [batch]


def augment(
    images: Float[Tensor, "batch 3 height width"], random: np.random.Generator, most: AugmentationStrength
) -> Float[Tensor, "batch 3 height width"]:
    """Pictures as a camera on a cluttered desk might take them; each is augmented with strengths of its own.

    Args:
        images: sRGB in [0, 1].
        random: Draws every strength.
        most: From which ranges.

    Returns:
        Images of the same shape, in [0, 1].
    """
    images = _occlude(images, random, most.occluded)
    drawn = _draw(images, random, most)
    at_once = max(1, _VALUES_AT_ONCE // images[0].numel())
    for first in range(0, len(images), at_once):
        part = slice(first, first + at_once)
        images[part] = _augmented(images[part], _Drawn._make(values[part] for values in drawn))
    return images


def _draw(images: Tensor, random: np.random.Generator, most: AugmentationStrength) -> _Drawn:
    count, _, height, width = images.shape

    def even(low: float, high: float, *shape: int) -> Tensor:
        return torch.from_numpy(random.uniform(low, high, (count, *shape))).to(images)

    saturation = even(*most.saturation, 1, 1)
    gain = even(*most.exposure, 1, 1) * even(1 - most.tint, 1 + most.tint, 3, 1)
    cells = int(random.integers(*_SHADE_CELLS))
    grid = torch.from_numpy(random.normal(size=(count, 1, cells, cells))).to(images) * even(0, most.shade, 1, 1, 1)
    down, across = (_smooth(size, cells).to(images) for size in (height, width))
    return _Drawn(
        light=down @ grid @ across.T,
        exponent=even(-most.gamma, most.gamma, 1, 1, 1).exp(),
        mixing=gain * (saturation * torch.eye(3).to(images) + (1 - saturation) / 3),
        contrast=even(*most.contrast, 1, 1),
        offset=even(-most.offset, most.offset, 1, 1),
        blur=even(0, most.blur, 1, 1, 1),
        noise=even(-most.noise, most.noise, 1, 1, 1),
        noise_start=torch.from_numpy(random.integers(_NOISE_STARTS, size=count)).to(images.device),
    )


def _augmented(images: Tensor, by: _Drawn) -> Tensor:
    # Uneven light and the camera's response to it, in the domain where one is a sum and the other a product.
    lit = images.clamp(min=_LEAST).log_().add_(by.light).clamp_(_DARKEST, 0).mul_(by.exponent).exp_()
    # Saturation, exposure, white balance, contrast: one matrix on the channels.
    middle = (by.mixing @ lit.mean((2, 3))[..., None]).mean(1, keepdim=True)
    bias = (1 - by.contrast) * middle + by.offset
    colored = torch.baddbmm(bias, by.contrast * by.mixing, lit.flatten(2)).view_as(lit)
    blurred = colored.mul(1 - by.blur).addcmul_(_gaussian(colored), by.blur)
    return blurred.addcmul_(_noise(blurred, by.noise_start), by.noise).clamp_(0, 1)


@functools.cache
def _smooth(size: int, cells: int) -> Float[Tensor, "size cells"]:
    """What each cell of a coarse line adds to each pixel of a fine one: bicubic, the corners are those of the line."""
    return F.interpolate(torch.eye(cells)[None, :, :, None], (size, 1), mode="bicubic", align_corners=True)[0, ..., 0].T


def _gaussian(images: Tensor) -> Tensor:
    """Approximates a Gaussian blur of one pixel by binomial weights 1, 4, 6, 4, 1 along both axes."""
    # Four sums of neighbours an axis: several times faster on a CPU than a grouped convolution.
    wide = F.pad(images, (2, 2, 2, 2), mode="replicate")
    for axis in (-2, -1) * 4:
        size = wide.shape[axis] - 1
        wide = wide.narrow(axis, 0, size) + wide.narrow(axis, 1, size)
    return wide.mul_(1 / 256)


def _noise(images: Tensor, starts: Tensor) -> Tensor:
    """Gaussian noise, for each image another stretch of one long sequence: drawing it anew costs ten times as much."""
    num_values = images[0].numel()
    windows = _noise_line(num_values, images.device).unfold(0, num_values, 1)
    return windows[starts].view_as(images)


@functools.cache
def _noise_line(num_values: int, device: torch.device) -> Tensor:
    values = np.random.default_rng(0).standard_normal(_NOISE_STARTS + num_values, dtype=np.float32)
    return torch.from_numpy(values).to(device)


def _occlude(images: Tensor, random: np.random.Generator, fraction: float) -> Tensor:
    """A copy, in which some images have a piece of another image of the batch in front: a rotated rectangle."""
    images, before = images.clone(), images
    chosen = np.flatnonzero(random.random(len(images)) < fraction)
    for image, mask in zip(
        chosen.tolist(), _rectangles(len(chosen), images.shape[2], images.shape[3], random), strict=True
    ):
        torch.where(mask.to(images.device), before[image - 1].flip(-1), before[image], out=images[image])
    return images


def _rectangles(count: int, height: int, width: int, random: np.random.Generator) -> Bool[Tensor, "count height width"]:
    """Masks of rectangles of random position, size and direction."""
    angle = random.uniform(0, np.pi, (count, 1, 1))
    center_x, center_y = random.uniform(-1, 1, (2, count, 1, 1))
    half = random.uniform(0.05, LARGEST_OCCLUDER, (2, count, 1, 1)).astype(np.float32)
    x, y = np.linspace(-1, 1, width) - center_x, np.linspace(-1, 1, height)[:, None] - center_y
    cos, sin = np.cos(angle), np.sin(angle)
    sides = ((x * cos, y * sin), (x * -sin, y * cos))
    within = [np.abs(a.astype(np.float32) + b.astype(np.float32)) < h for (a, b), h in zip(sides, half, strict=True)]
    return torch.from_numpy(within[0] & within[1])
