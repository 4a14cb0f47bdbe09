"""An encoder that looks for its object: features on a grid, averaged where attention falls.

The paper's encoder brings the whole image down to one code, in which a small object's place is slow to learn. Here the
place is read off the attention itself (spatial soft-argmax, Levine et al. 2016, "End-to-End Training of Deep Visuomotor
Policies"), so that what is learned at one place holds at all.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

LATENT = 64
_WIDTHS, _KERNELS = (32, 48, 64, 64), (5, 3, 3, 3)
_STRIDES, _DILATIONS = (2, 2, 1, 1), (1, 1, 1, 2)


class AttentionEncoder(nn.Module):
    """Image to latent code and place."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for num_in, width, kernel, stride, dilation in zip(
            (3, *_WIDTHS), _WIDTHS, _KERNELS, _STRIDES, _DILATIONS, strict=False
        ):
            padding = dilation * (kernel // 2)
            convolution = nn.Conv2d(num_in, width, kernel, stride, padding, dilation)
            layers += [convolution, nn.BatchNorm2d(width), nn.ReLU()]
        self.layers = nn.Sequential(*layers)
        self.attention = nn.Conv2d(_WIDTHS[-1], 1, 1)
        self.values = nn.Conv2d(_WIDTHS[-1], LATENT, 1)

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, "batch latent_and_place"]:
        """Latent codes of sRGB images in [0, 1], then the place (x, y), −1 to 1 from edge to edge."""
        features = self.layers(2 * images - 1)
        # Sums over a thousand cells need more digits than bfloat16 has.
        weights = self.attention(features).float().flatten(2).softmax(-1).unflatten(-1, features.shape[-2:])
        latent = (self.values(features).float() * weights).sum((-2, -1))
        place = torch.stack([_mean_place(weights.sum(across)[:, 0]) for across in (-2, -1)], dim=-1)
        return torch.cat([latent, place], dim=-1)


def _mean_place(weights: Float[Tensor, "batch cells"]) -> Float[Tensor, " batch"]:
    # With odd kernels padded by half their size, cell i looks at pixel i * stride and not at the middle of its square.
    stride, count = math.prod(_STRIDES), weights.shape[1]
    pixels = torch.arange(count, device=weights.device, dtype=weights.dtype) * stride
    return weights @ ((pixels + 0.5) * 2 / (count * stride) - 1)
