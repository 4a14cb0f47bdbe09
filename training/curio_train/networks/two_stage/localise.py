"""Network of the localisation stage: centre proposals for one object in a whole frame, one from each grid cell.

Every cell predicts how likely the object's centre is near it, and the object's position if so. What is learned at one
position thus holds at all, and two regions that look like the object are two proposals instead of a mean between them.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from curio_train.networks.base import StageNetwork
from curio_train.networks.grid import STRIDE, CellGrid
from curio_train.networks.layers import convolution
from curio_train.scene_code import TRANSLATION

PROPOSALS, HEAT_MAP = "proposals_m", "heat_map_logits"
"""Keys beside the position that ``LocalisationNetwork.decode`` returns: the proposal of each cell [batch, cells, 3],
and the logits of the centre heat map [batch, cells]."""
TOP_PROPOSALS, TOP_LOG_WEIGHTS = "top_proposals_m", "top_log_weights"
"""Keys of the likeliest proposals that are not neighbours [batch, NUM_TOP, 3], and of the logarithm of the heat around
each [batch, NUM_TOP]."""

NUM_TOP = 6

_WIDTHS = (24, 48, 96)
_CONTEXT_DILATIONS = (1, 2, 1)
_LEAST_WEIGHT = 1e-6
_EMPTY_LOGIT = -4.0  # of the heat map at the start: most cells have no object
_LEAST_DISTANCE = 2  # cells between top proposals, across or down


class LocalisationNetwork(StageNetwork):
    """Frame to position."""

    def __init__(self, grid: CellGrid) -> None:
        """Build for frames of the grid's camera."""
        super().__init__()
        self.grid = grid
        self.encoder = nn.Sequential(
            convolution(3, _WIDTHS[0], 5, 2),
            convolution(_WIDTHS[0], _WIDTHS[1], 3, 2),
            convolution(_WIDTHS[1], _WIDTHS[2], 3, 2),
            *(convolution(_WIDTHS[2], _WIDTHS[2], 3, 1, dilation) for dilation in _CONTEXT_DILATIONS),
        )
        self.score = nn.Conv2d(_WIDTHS[2], 1, 1)
        self.place = nn.Conv2d(_WIDTHS[2], 3, 1)
        nn.init.zeros_(self.place.weight)
        assert self.place.bias is not None
        nn.init.zeros_(self.place.bias)
        assert self.score.bias is not None
        nn.init.constant_(self.score.bias, _EMPTY_LOGIT)

    def decode(
        self, features: Float[Tensor, "batch channels rows columns"]
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """No raw values, and the code: the likeliest position, with all proposals beside it."""
        logits = self.score(features).flatten(1)
        values = self.place(features).flatten(2).transpose(1, 2)
        proposals = self.grid.locate(self.grid.pixels + STRIDE * values[..., :2], values[..., 2:].tanh())
        # Neighbours that propose the same position each have a part of its heat: they are counted together.
        heat = logits.sigmoid()
        around = F.avg_pool2d(heat.unflatten(1, (self.grid.rows, self.grid.columns))[:, None], 3, 1, 1).flatten(1)
        top, weights = self._top_proposals(proposals, around + heat)
        beside = {PROPOSALS: proposals, HEAT_MAP: logits}
        beside |= {TOP_PROPOSALS: top, TOP_LOG_WEIGHTS: weights.clamp(min=_LEAST_WEIGHT).log()}
        return {}, {TRANSLATION: top[:, :1], **beside}

    def _top_proposals(
        self, proposals: Float[Tensor, "batch cells 3"], weights: Float[Tensor, "batch cells"]
    ) -> tuple[Float[Tensor, "batch top 3"], Float[Tensor, "batch top"]]:
        """Non-maximum suppression: the likeliest proposal, the likeliest of those not near it, and so on."""
        pixels = self.grid.project(proposals)
        found, found_weights = [], []
        for _ in range(NUM_TOP):
            best = weights.argmax(dim=1, keepdim=True)
            found_weights.append(weights.gather(1, best))
            best = best[..., None].expand(-1, 1, 3)
            found.append(proposals.gather(1, best))
            distance = (pixels - pixels.gather(1, best[..., :2])).abs().amax(dim=-1)
            weights = weights * (distance > _LEAST_DISTANCE * STRIDE)
        return torch.cat(found, dim=1), torch.cat(found_weights, dim=1)
