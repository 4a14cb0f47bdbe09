"""The templates of one object seen from all sides, as they are drawn: before they are compressed."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from curio_train.networks.templates.descriptors import Descriptors

COARSE_SIZE = 24
RANK = 56
"""Filters that all templates are sums of."""

NUM_POINTS = 76
"""Surface points a template that poses are aligned by."""

NUM_OUTLINE_POINTS = 32
"""Points of the outline in each direction."""


@dataclass(frozen=True, eq=False)
class Bank:
    """All templates, in the order of :func:`~curio_train.networks.templates.geometry.viewpoints`."""

    coarse: Descriptors
    """Descriptors at stride 8, from which rotations are read."""
    fine: Descriptors
    """Descriptors at stride 4, by which poses are aligned."""
    filters: Float[Tensor, "rank size cells cells"]
    """Whole templates as weighted sums of few filters."""
    weights: Float[Tensor, "templates rank"]
    """Weights of the filters in each template."""
    points: Float[Tensor, "templates points 3"]
    """Points on the surface, object frame, diameters."""
    described: Float[Tensor, "templates points channels"]
    """Fine descriptors of the points."""
    outline: Float[Tensor, "views points 3"]
    """Points on the outline in each direction, object frame, diameters."""
    outward: Float[Tensor, "views points 3"]
    """Unit vectors out of the outline, across the line of sight, object frame."""
