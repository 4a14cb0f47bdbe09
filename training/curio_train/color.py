"""sRGB and linear light in torch (IEC 61966-2-1), differentiably; values are clipped to [0, 1] like a camera's."""

import torch
from torch import Tensor


def linear_from_srgb(srgb: Tensor) -> Tensor:
    """Decode sRGB to linear light."""
    srgb = srgb.clamp(0, 1)
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp(min=0.04) + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(linear: Tensor) -> Tensor:
    """Encode linear light to sRGB."""
    linear = linear.clamp(0, 1)
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp(min=1e-4) ** (1 / 2.4) - 0.055)
