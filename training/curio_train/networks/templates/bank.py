"""The templates of one object seen from all sides, to be compared with crops as a whole and point by point."""

import torch
from torch import Tensor, nn

from curio_train.networks.templates.descriptors import Descriptors
from curio_train.networks.templates.geometry import CROP_PX, NUM_ROLLS, NUM_VIEWS, viewpoints
from curio_train.networks.templates.trunk import COARSE_STRIDE, COARSE_WIDTH, FINE_WIDTH

COARSE_SIZE = 24
RANK = 96
"""Filters that all templates are sums of."""

NUM_POINTS = 80
"""Surface points a template that poses are aligned by."""

LARGEST_BYTE = 127
"""Of a stored descriptor: signed bytes."""


class Bank(nn.Module):
    """All templates."""

    coarse: Descriptors
    """Descriptors at stride 8, from which rotations are read."""
    fine: Descriptors
    """Descriptors at stride 4, by which poses are aligned."""
    filters: Tensor
    """Whole templates as weighted sums of few filters, [RANK, COARSE_SIZE, cells, cells]."""
    weights: Tensor
    """Of the filters in each template, [templates, RANK]."""
    points: Tensor
    """On the surface, object frame, diameters, [templates, points, 3]."""
    described: Tensor
    """Fine descriptors of the points, times 127, [templates, points, FINE_WIDTH]."""
    rotations: Tensor
    """cam_from_obj of an object on the optical axis, [templates, 3, 3]; the same for every object."""

    def __init__(self) -> None:
        super().__init__()
        num, side = NUM_VIEWS * NUM_ROLLS, CROP_PX // COARSE_STRIDE
        self.coarse = Descriptors(COARSE_WIDTH, COARSE_SIZE)
        self.fine = Descriptors(FINE_WIDTH, FINE_WIDTH)
        self.register_buffer("filters", torch.zeros(RANK, COARSE_SIZE, side, side).half())
        self.register_buffer("weights", torch.zeros(num, RANK).half())
        self.register_buffer("points", torch.zeros(num, NUM_POINTS, 3).half())
        self.register_buffer("described", torch.zeros(num, NUM_POINTS, FINE_WIDTH, dtype=torch.int8))
        self.register_buffer("rotations", viewpoints(NUM_VIEWS, NUM_ROLLS), persistent=False)

    def store(self, points: Tensor, described: Tensor) -> None:
        """Round points [templates, points, 3] and descriptors [templates, points, FINE_WIDTH], and keep them."""
        self.points.copy_(points)
        self.described.copy_((LARGEST_BYTE * described).round().clamp(-LARGEST_BYTE, LARGEST_BYTE))
