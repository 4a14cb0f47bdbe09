"""The first look's network: where one object is in a whole frame, as weighted hypotheses on a grid.

Every cell says where the object would be if it were near that cell, and how likely that is. What is learned at one
place so holds at all, and two things that look like the object are two hypotheses instead of a mean between them.
"""

import math

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from curio_train.networks.layers import convolution
from curio_train.networks.look import Look
from curio_train.scene_code import TRANSLATION, Field

PLACES, LOG_WEIGHTS = "places_m", "place_log_weights"
CANDIDATES, CANDIDATE_LOG_WEIGHTS = "candidates_m", "candidate_log_weights"
"""What :meth:`PlaceNetwork.decode` gives beside the place: all hypotheses [batch, cells, 3] with their log weights, and
the likeliest places that are not beside each other [batch, NUM_CANDIDATES, 3] with the logarithm of the weight around
each."""

NUM_CANDIDATES = 6

STRIDE = 8
_WIDTHS = (24, 48, 96)
_CONTEXT_DILATIONS = (1, 2, 1)
_LEAST_WEIGHT = 1e-6
_APART = 2  # cells that candidates are at least apart, across or down


class PlaceNetwork(Look):
    """Frame to position."""

    def __init__(self, field: Field, matrix: np.ndarray, width: int, height: int) -> None:
        """Build for frames of one camera.

        Args:
            field: The position; ``perspective``, its depth range bounds the answers.
            matrix: K of the frames.
            width: Of the frames, pixels.
            height: Of the frames, pixels.
        """
        super().__init__()
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
        rows, columns = math.ceil(height / STRIDE), math.ceil(width / STRIDE)
        v, u = np.meshgrid(np.arange(rows) * STRIDE, np.arange(columns) * STRIDE, indexing="ij")
        slopes = (np.stack([u, v], axis=-1).reshape(-1, 2) - matrix[[0, 1], 2]) / matrix[[0, 1], [0, 1]]
        self.cells: Tensor
        self.register_buffer("cells", torch.from_numpy(slopes).float(), persistent=False)
        self._pitch = STRIDE / float(matrix[0, 0])
        log_near, log_far = math.log(field.lower[2]), math.log(field.upper[2])
        self._middle, self._half = (log_near + log_far) / 2, (log_far - log_near) / 2

    def decode(
        self, features: Float[Tensor, "batch channels rows columns"]
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """No raw values, and the code: the place with the most weight around it, and what else is known of places."""
        scores = self.score(features)
        log_weights = scores.flatten(1).log_softmax(dim=-1)
        values = self.place(features).flatten(2).transpose(1, 2)
        slope = self.cells + self._pitch * values[..., :2]
        depth = (self._middle + self._half * torch.tanh(values[..., 2:])).exp()
        places = torch.cat([slope * depth, depth], dim=-1)
        # Neighbours that mean the same place share its weight: together they count as one, led by the strongest.
        weights = log_weights.exp()
        around = F.avg_pool2d(weights.unflatten(1, scores.shape[-2:])[:, None], 3, 1, 1).flatten(1)
        candidates, of_candidates = self._candidates(places, around + weights)
        known = {PLACES: places, LOG_WEIGHTS: log_weights}
        known |= {CANDIDATES: candidates, CANDIDATE_LOG_WEIGHTS: of_candidates.clamp(min=_LEAST_WEIGHT).log()}
        return {}, {TRANSLATION: candidates[:, :1], **known}

    def _candidates(
        self, places: Float[Tensor, "batch cells 3"], weights: Float[Tensor, "batch cells"]
    ) -> tuple[Float[Tensor, "batch candidates 3"], Float[Tensor, "batch candidates"]]:
        """The likeliest place, the likeliest of those not beside it, and so on, each with its weight."""
        slopes = places[..., :2] / places[..., 2:]
        found, found_weights = [], []
        for _ in range(NUM_CANDIDATES):
            best = weights.argmax(dim=1, keepdim=True)
            found_weights.append(weights.gather(1, best))
            best = best[..., None].expand(-1, 1, 3)
            found.append(places.gather(1, best))
            distance = (slopes - slopes.gather(1, best[..., :2])).abs().amax(dim=-1)
            weights = weights * (distance > _APART * self._pitch)
        return torch.cat(found, dim=1), torch.cat(found_weights, dim=1)
