"""Where the object may be in a whole frame: templates of few views and several distances, correlated with it."""

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from curio_train.networks.templates.descriptors import Descriptors
from curio_train.networks.templates.geometry import FRAME_STRIDE, Geometry
from curio_train.networks.templates.trunk import COARSE_STRIDE, COARSE_WIDTH

NUM_CANDIDATES = 6
DESCRIPTOR_SIZE = 24
RANK, ANY_SIDE_RANK = 16, 32
"""Filters that the templates of one distance are sums of; more for an object that is seen from any side."""

_APART = 0.35  # diameters between candidates, at least
_APART_CELLS = 1.5
_SUPPRESSED = -1e4


class Candidates(NamedTuple):
    """Centre proposals."""

    position_m: Float[Tensor, "batch num 3"]
    """Position of the object's centre, camera frame."""
    score: Float[Tensor, "batch num"]
    """Standard deviations above what the same template scores on background."""


class Localiser(nn.Module):
    """Features of a frame to candidates.

    A template's score is the mean cosine over its silhouette. All templates of one distance are sums of few filters
    (singular value decomposition), so that a frame is filtered once a filter instead of once a template.
    """

    weights: Tensor
    """Weights of the filters in each template, divided by the score's standard deviation on background."""
    offsets: Tensor
    """Added to scores, so that their mean on background is 0."""
    _pixels: Tensor
    _rays: Tensor
    _depths: Tensor
    _apart: Tensor

    def __init__(self, geometry: Geometry) -> None:
        super().__init__()
        self.descriptors = Descriptors(COARSE_WIDTH, DESCRIPTOR_SIZE)
        depths, num = geometry.depths_m, len(geometry.localising_rotations)
        rank = ANY_SIDE_RANK if geometry.any_side else RANK
        for number, depth in enumerate(depths):
            side = geometry.kernel_cells(depth)
            self.register_buffer(f"filters_{number}", torch.zeros(rank, DESCRIPTOR_SIZE, side, side).half())
        self.register_buffer("weights", torch.zeros(len(depths), num, rank))
        self.register_buffer("offsets", torch.zeros(len(depths), num))
        self._num = len(depths)
        rows, columns = geometry.frame_cells
        v, u = np.mgrid[:rows, :columns].reshape(2, -1) * FRAME_STRIDE * COARSE_STRIDE + (FRAME_STRIDE - 1) / 2
        rays = np.linalg.solve(geometry.matrix, np.stack([u, v, np.ones_like(u)]))
        apart = [_APART * geometry.diameter_m * geometry.focal_px / depth for depth in depths]
        least = _APART_CELLS * FRAME_STRIDE * COARSE_STRIDE
        for name, value in {
            "_pixels": np.stack([u, v], axis=1),
            "_rays": (rays / np.linalg.norm(rays, axis=0)).T,
            "_depths": np.array(depths),
            "_apart": np.maximum(apart, least),
        }.items():
            self.register_buffer(name, torch.from_numpy(value).float(), persistent=False)

    def forward(self, features: Float[Tensor, "batch channels rows columns"]) -> Candidates:
        """The likeliest places that are not beside each other, likeliest first."""
        of_depths = [of_depth.amax(dim=1) for of_depth in self.scores(self.descriptors(features))]
        scores, scale = torch.stack(of_depths, dim=1).max(dim=1)
        positions, found = [], []
        for _ in range(NUM_CANDIDATES):
            score, cell = scores.max(dim=1)
            chosen = scale.gather(1, cell[:, None])[:, 0]
            positions.append(self._rays[cell] * self._depths[chosen][:, None])
            found.append(score)
            distance = (self._pixels[None] - self._pixels[cell][:, None]).square().sum(dim=-1)
            scores = torch.where(distance <= self._apart[chosen][:, None].square(), _SUPPRESSED, scores)
        return Candidates(torch.stack(positions, dim=1), torch.stack(found, dim=1))

    def scores(
        self, descriptors: Float[Tensor, "batch size rows columns"]
    ) -> list[Float[Tensor, "batch templates cells"]]:
        """Scores of every template centred on every cell, a list entry a distance."""
        found = []
        for number in range(self._num):
            filters = self.filters(number).float()
            filtered = F.conv2d(descriptors, filters, padding=filters.shape[-1] // 2).flatten(2)
            found.append(self.weights[number] @ filtered + self.offsets[number][:, None])
        return found

    def filters(self, number: int) -> Tensor:
        """Filters of one distance, [rank, DESCRIPTOR_SIZE, side, side]."""
        filters: Tensor = getattr(self, f"filters_{number}")
        return filters
