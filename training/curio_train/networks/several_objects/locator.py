"""Where each of several objects may be in a frame: one centre heat map an object, on frozen pretrained features.

What the paper's first stage would learn in days from renderings, local features bring along, and they carry over to
photographs; only the head is trained (docs/experiments/real_photographs.md).
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from curio_train.networks.base import StageNetwork
from curio_train.networks.grid import STRIDE, CellGrid
from curio_train.networks.layers import convolution
from curio_train.networks.templates.trunk import COARSE_STRIDE, COARSE_WIDTH, FINE_STRIDE, FINE_WIDTH, Trunk
from curio_train.scene_code import CONFIDENCE, TRANSLATION

HEAT_MAPS, PROPOSALS = "heat_map_logits", "proposals_m"
"""Keys beside the code: logits [batch, objects, cells], and the position that each cell proposes
[batch, objects, cells, 3]."""

_WIDTH = 96
_DILATIONS = (1, 2, 4)
_EMPTY_LOGIT = -5.0  # of the heat maps at the start: most cells have no centre
_APART_CELLS = 2.5  # between the places of one object, at least
_SUPPRESSED = -1e4
_VALUES = 4  # of each object in each cell: heat, column, row, distance


class Found(NamedTuple):
    """Places of each object, likeliest first."""

    position_m: Float[Tensor, "batch objects num 3"]
    """Position of the object's centre."""
    logit: Float[Tensor, "batch objects num"]
    """Logit of the heat map."""


class FrameFeatures(nn.Module):
    """Frame to one feature map at stride 8, from both maps of the frozen trunk."""

    def __init__(self) -> None:
        super().__init__()
        self.trunk = Trunk().requires_grad_(False).eval()
        blocks = (COARSE_STRIDE // FINE_STRIDE) ** 2
        widths = (COARSE_WIDTH + blocks * FINE_WIDTH, *[_WIDTH] * len(_DILATIONS))
        self.context = nn.Sequential(
            *(convolution(widths[i], widths[i + 1], 3, 1, dilation) for i, dilation in enumerate(_DILATIONS))
        )

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, "batch channels rows columns"]:
        """Features of sRGB images in [0, 1]."""
        with torch.no_grad():
            fine, coarse = self.trunk(images)
        together = torch.cat([F.pixel_unshuffle(fine, COARSE_STRIDE // FINE_STRIDE), coarse], dim=1)
        features: Tensor = self.context(together)
        return features


class LocatorNetwork(StageNetwork):
    """Frame to a position and a confidence for each object."""

    has_raw_values = False

    def __init__(self, grid: CellGrid, num_objects: int) -> None:
        """Build for frames of the grid's camera."""
        super().__init__()
        self.grid, self._num = grid, num_objects
        self.encoder = FrameFeatures()
        self.head = nn.Conv2d(_WIDTH, _VALUES * num_objects, 1)
        assert self.head.bias is not None
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)
        nn.init.constant_(self.head.bias[:num_objects], _EMPTY_LOGIT)

    @property
    def trunk(self) -> Trunk:
        """The frozen feature extractor."""
        assert isinstance(self.encoder, FrameFeatures)
        return self.encoder.trunk

    def decode(
        self, features: Float[Tensor, "batch channels rows columns"]
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """No raw values, and the likeliest position of each object, with all proposals beside it."""
        heat, proposals = self._proposals(features)
        found = self._top(heat, proposals, 1)
        confidence = found.logit.sigmoid()
        return {}, {
            TRANSLATION: found.position_m[:, :, 0],
            CONFIDENCE: confidence,
            HEAT_MAPS: heat,
            PROPOSALS: proposals,
        }

    def places(self, images: Float[Tensor, "batch 3 height width"], num: int, slots: Int[Tensor, " objects"]) -> Found:
        """The likeliest ``num`` places, not beside each other, of each of the objects in ``slots``."""
        heat, proposals = self._proposals(self.encoder(images))
        return self._top(heat[:, slots], proposals[:, slots], num)

    def _proposals(
        self, features: Tensor
    ) -> tuple[Float[Tensor, "batch objects cells"], Float[Tensor, "batch objects cells 3"]]:
        values = self.head(features).flatten(2).unflatten(1, (_VALUES, self._num))
        heat, shift, along = values[:, 0], values[:, 1:3].permute(0, 2, 3, 1), values[:, 3, ..., None]
        return heat, self.grid.locate(self.grid.pixels + STRIDE * shift, along.tanh())

    def _top(self, heat: Tensor, proposals: Tensor, num: int) -> Found:
        """Non-maximum suppression: the likeliest cell, the likeliest of those not near it, and so on."""
        pixels = self.grid.pixels
        positions, logits = [], []
        for _ in range(num):
            logit, best = heat.max(dim=2)
            logits.append(logit)
            positions.append(proposals.gather(2, best[..., None, None].expand(-1, -1, 1, 3))[:, :, 0])
            near = (pixels - pixels[best][:, :, None]).square().sum(dim=-1) < (_APART_CELLS * STRIDE) ** 2
            heat = torch.where(near, _SUPPRESSED, heat)
        return Found(torch.stack(positions, dim=2), torch.stack(logits, dim=2))
