"""The second look's network: pose and light of one object that fills a crop.

On its way it says, for each of 16x16 patches, whether the object is seen there and which point of it. Those 1,024
numbers an image teach the features long before nine numbers of a pose can (dense coordinates as in Wang et al. 2021,
"GDR-Net"). Of several crops of a frame the gaze goes on with one that shows the object most clearly.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from curio_train.networks.heads import Heads
from curio_train.networks.layers import Residual, convolution
from curio_train.networks.look import Look
from curio_train.scene_code import ROTATION_6D, Layout

SURFACE = "surface"
"""What :meth:`CropNetwork.decode` gives beside the code: [batch, 4, 16, 16], the point of the object each patch sees
(three coordinates, in half extents from the middle of its box), then the logit of seeing the object at all."""

SURFACE_SHARE = 4
"""Pixels a side of a patch."""

_WIDTHS = (48, 64, 128, 256)
_LATENT = 256
_ROW = 128


class CropNetwork(Look):
    """Crop to scene code."""

    def __init__(self, layout: Layout, side: int) -> None:
        """Build for square crops of ``side`` pixels, a multiple of 16."""
        super().__init__()
        self.encoder = nn.Sequential(
            convolution(3, _WIDTHS[0], 5, 2),
            convolution(_WIDTHS[0], _WIDTHS[1], 3, 2),
            Residual(_WIDTHS[1]),
            convolution(_WIDTHS[1], _WIDTHS[2], 3, 2),
            Residual(_WIDTHS[2]),
            Residual(_WIDTHS[2]),
            _Described(_WIDTHS[2], 4 * 4),
        )
        self.unfold = nn.PixelShuffle(2)
        self.latent = nn.Sequential(
            convolution(_WIDTHS[2] + 16, _WIDTHS[3], 3, 2),
            nn.Flatten(),
            nn.Linear(_WIDTHS[3] * (side // 16) ** 2, _LATENT),
            nn.ReLU(),
        )
        self.heads = Heads(layout, _LATENT, _ROW, _ROW)
        _begin_with_identity(self.heads)

    def decode(
        self, features: Float[Tensor, "batch channels rows columns"]
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """The heads' raw outputs, and the code with :data:`SURFACE` beside it."""
        raw = self.heads.raw(self.latent(features))
        return raw, self.heads.layout.activate(raw) | {SURFACE: self.unfold(features[:, -16:])}


class _Described(nn.Module):
    """Features, followed by what a linear map says of them."""

    def __init__(self, width: int, num_values: int) -> None:
        super().__init__()
        self.values = nn.Conv2d(width, num_values, 1)

    def forward(self, features: Tensor) -> Tensor:
        return torch.cat([features, self.values(features)], dim=1)


def _begin_with_identity(heads: Heads) -> None:
    """A rotation of zeros has no gradient worth following: start small, from the identity."""
    last = heads.branches[ROTATION_6D][-1]  # type: ignore[index]
    with torch.no_grad():
        last.weight.mul_(0.1)
        last.bias.copy_(torch.tensor([1.0, 0, 0, 0, 1, 0]))
