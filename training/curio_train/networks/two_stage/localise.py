"""The first look's network: where one object is in a whole frame, as weighted hypotheses on a grid.

Every cell says where the object would be if it were near that cell, and how likely that is. What is learned at one
place so holds at all, and two things that look like the object are two hypotheses instead of a mean between them.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from curio_train.networks.base import StageNetwork
from curio_train.networks.grid import STRIDE, CellGrid
from curio_train.networks.layers import convolution
from curio_train.scene_code import TRANSLATION

PROPOSALS, HEAT_MAP = "places_m", "place_amounts"
CANDIDATES, CANDIDATE_LOG_WEIGHTS = "candidates_m", "candidate_log_weights"
"""What ``LocalisationNetwork.decode`` gives beside the place: all hypotheses [batch, cells, 3] with the logits of how
much of an object is there [batch, cells], and the likeliest places that are not beside each other
[batch, NUM_CANDIDATES, 3] with the logarithm of the weight around each."""

NUM_CANDIDATES = 6

_WIDTHS = (24, 48, 96)
_CONTEXT_DILATIONS = (1, 2, 1)
_LEAST_WEIGHT = 1e-6
_SCARCE = -4.0  # logit of an amount at the start: most cells hold nothing
_APART = 2  # cells that candidates are at least apart, across or down


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
        nn.init.constant_(self.score.bias, _SCARCE)

    def decode(
        self, features: Float[Tensor, "batch channels rows columns"]
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """No raw values, and the code: the place with the most weight around it, and what else is known of places."""
        amounts = self.score(features).flatten(1)
        values = self.place(features).flatten(2).transpose(1, 2)
        places = self.grid.locate(self.grid.pixels + STRIDE * values[..., :2], values[..., 2:].tanh())
        # Neighbours that mean the same place share its weight: together they count as one, led by the strongest.
        weights = amounts.sigmoid()
        around = F.avg_pool2d(weights.unflatten(1, (self.grid.rows, self.grid.columns))[:, None], 3, 1, 1).flatten(1)
        candidates, of_candidates = self._candidates(places, around + weights)
        known = {PROPOSALS: places, HEAT_MAP: amounts}
        known |= {CANDIDATES: candidates, CANDIDATE_LOG_WEIGHTS: of_candidates.clamp(min=_LEAST_WEIGHT).log()}
        return {}, {TRANSLATION: candidates[:, :1], **known}

    def _candidates(
        self, places: Float[Tensor, "batch cells 3"], weights: Float[Tensor, "batch cells"]
    ) -> tuple[Float[Tensor, "batch candidates 3"], Float[Tensor, "batch candidates"]]:
        """The likeliest place, the likeliest of those not beside it, and so on, each with its weight."""
        pixels = self.grid.project(places)
        found, found_weights = [], []
        for _ in range(NUM_CANDIDATES):
            best = weights.argmax(dim=1, keepdim=True)
            found_weights.append(weights.gather(1, best))
            best = best[..., None].expand(-1, 1, 3)
            found.append(places.gather(1, best))
            distance = (pixels - pixels.gather(1, best[..., :2])).abs().amax(dim=-1)
            weights = weights * (distance > _APART * STRIDE)
        return torch.cat(found, dim=1), torch.cat(found_weights, dim=1)
