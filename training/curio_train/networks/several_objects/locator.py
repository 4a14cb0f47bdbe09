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
        beginning, *others = self.context
        assert isinstance(beginning, nn.Sequential)
        first, *rest = beginning
        assert isinstance(first, nn.Conv2d)
        features = _of_both(first, fine, coarse)
        for layer in (*rest, *others):
            features = layer(features)
        return features


def _of_both(first: nn.Conv2d, fine: Tensor, coarse: Tensor) -> Tensor:
    """The first convolution, of the fine map's cells side by side (``pixel_unshuffle``) and the coarse map.

    The fine map's weights are laid out as its cells are, so that an exported graph does not move cells.
    """
    ratio = COARSE_STRIDE // FINE_STRIDE
    width = ratio**2 * FINE_WIDTH
    of_fine, of_coarse = first.weight.narrow(1, 0, width), first.weight.narrow(1, width, COARSE_WIDTH)
    cells = of_fine.unflatten(1, (FINE_WIDTH, ratio, ratio))  # [outputs, channels, down, across, rows, columns]
    of_fine = cells.permute(0, 1, 4, 2, 5, 3).flatten(4, 5).flatten(2, 3)
    return F.conv2d(fine, of_fine, None, ratio, ratio) + F.conv2d(coarse, of_coarse, first.bias, padding=1)


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
        values = self._values(features)
        heat, proposals = values[:, 0], self._proposals(values, self.grid.pixels)
        cells, logit = self._top(heat, 1)
        position = proposals.gather(2, cells[..., None].expand(-1, -1, -1, 3))[:, :, 0]
        code = {TRANSLATION: position, CONFIDENCE: logit.sigmoid()}
        return {}, code | {HEAT_MAPS: heat, PROPOSALS: proposals}

    def places(self, images: Float[Tensor, "batch 3 height width"], num: int, slots: Int[Tensor, " objects"]) -> Found:
        """The likeliest ``num`` places, not beside each other, of each of the objects in ``slots``."""
        values = self._values(self.encoder(images)).index_select(2, slots)
        cells, logit = self._top(values[:, 0], num)
        pixels = self.grid.pixels.index_select(0, cells.flatten()).unflatten(0, (-1, *cells.shape[1:]))
        chosen = values.gather(3, cells[:, None].expand(-1, _VALUES, -1, -1))
        return Found(self._proposals(chosen, pixels), logit)

    def _values(self, features: Tensor) -> Float[Tensor, "batch 4 objects cells"]:
        """Heat, column, row and distance, of each object in each cell."""
        return self.head(features).flatten(2).unflatten(1, (_VALUES, self._num))

    def _proposals(
        self, values: Float[Tensor, "batch 4 objects cells"], pixels: Float[Tensor, "*objects cells 2"]
    ) -> Float[Tensor, "batch objects cells 3"]:
        """The positions that cells at these pixels propose."""
        shift, along = values[:, 1:3].permute(0, 2, 3, 1), values[:, 3, ..., None]
        return self.grid.locate(pixels + STRIDE * shift, along.tanh())

    def _top(
        self, heat: Float[Tensor, "batch objects cells"], num: int
    ) -> tuple[Int[Tensor, "batch objects num"], Float[Tensor, "batch objects num"]]:
        """Non-maximum suppression: the likeliest cell, the likeliest of those not near it, and so on; their logits."""
        pixels, cells, logits = self.grid.pixels, [], []
        for _ in range(num):
            logit, best = heat.max(dim=2)
            logits.append(logit)
            cells.append(best)
            near = (pixels - pixels[best][:, :, None]).square().sum(dim=-1) < (_APART_CELLS * STRIDE) ** 2
            heat = torch.where(near, _SUPPRESSED, heat)
        return torch.stack(cells, dim=2), torch.stack(logits, dim=2)
