"""What lies between a rendering and a photograph: light, exposure, colour, blur, noise, things in front (torch)."""

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

LARGEST_OCCLUDER = 0.35  # of the image's side
_LARGEST_SHADE = 0.45  # standard deviation of the logarithm of uneven light
_SHADE_CELLS = (2, 5)  # of its grid, a side: from a gradient over the image to shadows of a third of it
_LARGEST_GAMMA = 0.35  # as a logarithm


def disturb(images: Float[Tensor, "batch 3 height width"], random: np.random.Generator) -> Tensor:
    """Pictures as a camera on a cluttered desk might take them; each is disturbed by amounts of its own.

    Args:
        images: sRGB in [0, 1].
        random: Draws every amount.

    Returns:
        Images of the same shape, in [0, 1].
    """
    images = _occlude(images, random)
    images = _shade(images, random)
    images = _recolor(images, random)
    images = _blur(images, random)
    noise = torch.randn(images.shape, generator=torch.Generator().manual_seed(int(random.integers(2**63)))).to(images)
    return (images + noise * _amounts(images, random, 0.0, 0.05)).clamp(0, 1)


def _amounts(images: Tensor, random: np.random.Generator, low: float, high: float, channels: int = 1) -> Tensor:
    values = random.uniform(low, high, (len(images), channels, 1, 1)).astype(np.float32)
    return torch.from_numpy(values).to(images)


def _shade(images: Tensor, random: np.random.Generator) -> Tensor:
    """Light that falls unevenly, as next to other things, and a camera's response to it."""
    cells = int(random.integers(*_SHADE_CELLS))
    grid = torch.from_numpy(random.normal(size=(len(images), 1, cells, cells)).astype(np.float32)).to(images)
    field = F.interpolate(grid, images.shape[-2:], mode="bicubic", align_corners=True)
    lit = images * torch.exp(field * _amounts(images, random, 0.0, _LARGEST_SHADE))
    return lit.clamp(1e-4, 1) ** torch.exp(_amounts(images, random, -_LARGEST_GAMMA, _LARGEST_GAMMA))


def _recolor(images: Tensor, random: np.random.Generator) -> Tensor:
    """Exposure, white balance, contrast and saturation."""
    grey = images.mean(1, keepdim=True)
    images = grey + (images - grey) * _amounts(images, random, 0.3, 1.6)
    images = images * _amounts(images, random, 0.5, 1.5) * _amounts(images, random, 0.85, 1.15, channels=3)
    middle = images.mean((1, 2, 3), keepdim=True)
    return middle + (images - middle) * _amounts(images, random, 0.6, 1.3) + _amounts(images, random, -0.1, 0.1)


def _blur(images: Tensor, random: np.random.Generator) -> Tensor:
    """Mixes each image with its blurred self: from sharp to a Gaussian of about one pixel."""
    # Shifted sums along one axis and then the other: several times faster on a CPU than a grouped convolution.
    wide = F.pad(images, (2, 2, 2, 2), mode="replicate")
    for axis in (-2, -1):
        size = wide.shape[axis] - 4
        taps = [wide.narrow(axis, start, size) for start in range(5)]
        wide = (taps[0] + taps[4] + 4 * (taps[1] + taps[3]) + 6 * taps[2]) / 16
    return torch.lerp(images, wide, _amounts(images, random, 0.0, 1.0))


def _occlude(images: Tensor, random: np.random.Generator) -> Tensor:
    """Half of the images get a piece of another image of the batch in front: a rotated rectangle."""
    count, _, height, width = images.shape
    y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    angle = random.uniform(0, np.pi, (count, 1, 1))
    center_x, center_y = random.uniform(-1, 1, (2, count, 1, 1))
    across = (x - center_x) * np.cos(angle) + (y - center_y) * np.sin(angle)
    along = (y - center_y) * np.cos(angle) - (x - center_x) * np.sin(angle)
    half = random.uniform(0.05, LARGEST_OCCLUDER, (2, count, 1, 1)) * (random.random((count, 1, 1)) < 0.5)
    mask = torch.from_numpy((np.abs(across) < half[0]) & (np.abs(along) < half[1]))[:, None].to(images.device)
    return torch.where(mask, images.roll(1, dims=0).flip(-1), images)
