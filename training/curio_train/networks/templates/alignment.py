"""A pose aligned with a crop by features at surface points: no rendering, six unknowns (as in FoundPose, 2024).

Levenberg–Marquardt on the distance between the descriptor that a template has at a surface point and the one that the
crop has where the pose projects it, with a robust weight for each point. All of it is plain tensor arithmetic, so that
it can be part of an exported graph.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from curio_train.networks.pose_steps import solve_augmented, turn
from curio_train.networks.templates.trunk import FINE_STRIDE

_DAMPING = 1e-2  # of the Hessian's diagonal
_RIDGE = 1e-6
_LARGEST_STEP = 0.2  # radians and diameters together
_NEAREST = 1e-3  # diameters
_OUTLIER = 0.5  # squared distance of descriptors at which a point counts a quarter (Geman and McClure 1985)

_BY_ARM = [  # what rotations and shifts move x, then y, then z by, from the arm: six rows each
    *([0, 0, 0], [0, 0, 1], [0, -1, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]),
    *([0, 0, -1], [0, 0, 0], [1, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]),
    *([0, 1, 0], [-1, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]),
]
_BY_SHIFT = [[float(row in (3, 10, 17))] for row in range(18)]  # and without it
_CORNERS = [[[0], [1], [0], [1]], [[0], [0], [1], [1]]]
"""Columns, then rows, of the four cells around a point, counted from the first."""


class FeatureMaps(NamedTuple):
    """Descriptors of crops, and twice their derivatives across and down a cell.

    In each map, cell after cell, row after row, crop after crop; cell (i, j) lies at crop pixel (4 i, 4 j).
    """

    here: Float[Tensor, "crops*side*side size"]
    """Descriptors."""
    across: Float[Tensor, "crops*side*side size"]
    """Those of the cell to the right less those of the cell to the left."""
    down: Float[Tensor, "crops*side*side size"]
    """Those of the cell below less those of the cell above."""
    side: int
    """Cells along a side of the crop."""

    @classmethod
    def of(cls, descriptors: Float[Tensor, "crops size side side"]) -> "FeatureMaps":
        """The maps of descriptors."""
        here, side = descriptors.permute(0, 2, 3, 1), descriptors.shape[-1]
        cells = torch.arange(side, device=descriptors.device)
        before, after = (cells - 1).clamp(min=0), (cells + 1).clamp(max=side - 1)
        across, down = (here.index_select(axis, after) - here.index_select(axis, before) for axis in (2, 1))
        here, across, down = (values.flatten(0, 2) for values in (here, across, down))
        return cls(here, across, down, side)

    def around(self, crop: Int[Tensor, " batch"], place: Float[Tensor, "batch 2 points"]) -> "Corners":
        """The cells around columns and rows; those at the border where a point lies outside."""
        place = place.clamp(0, self.side - 1)
        first = place.floor().clamp(max=self.side - 2)
        strides, corners = place.new_tensor([[1.0, self.side]]), place.new_tensor(_CORNERS)
        begin = (crop * self.side**2)[:, None] + (strides[0] @ corners[..., 0]).long()
        beyond = (place - first).unsqueeze(2)
        across, down = (corners * beyond + (1 - corners) * (1 - beyond)).unbind(1)
        # A product of matrices repeats weights: onnxruntime takes twice as long to multiply by what it repeats itself.
        weight = (across * down)[..., None] @ place.new_ones(1, self.here.shape[1])
        return Corners((strides @ first).long() + begin[..., None], weight)


class Corners(NamedTuple):
    """The four cells around each of a number of points, with bilinear weights."""

    cell: Int[Tensor, "batch 4 points"]
    """Numbers of the cells in a map."""
    weight: Float[Tensor, "batch 4 points size"]
    """The same in all channels; they sum to 1 for each point."""

    def of(self, values: Float[Tensor, "cells size"]) -> Float[Tensor, "batch points size"]:
        """Bilinear values of a map."""
        # index_select and a sum, not indexing and lerp, which take an exported graph several times as long.
        corners = values.index_select(0, self.cell.flatten()).unflatten(0, (-1, *self.cell.shape[1:]))
        return (self.weight * corners).sum(dim=1)


class Aligned(NamedTuple):
    """Poses in the cameras of their crops."""

    rotation: Float[Tensor, "batch 3 3"]
    """crop_from_obj."""
    position: Float[Tensor, "batch 3"]
    """Position of the object, diameters."""
    score: Float[Tensor, " batch"]
    """Mean cosine of template and crop over the points."""


def align(
    maps: FeatureMaps,
    crop: Int[Tensor, " batch"],
    points: Float[Tensor, "batch points 3"],
    wanted: Float[Tensor, "batch points size"],
    start: Aligned,
    focal_px: Float[Tensor, " batch"],
    num_steps: int,
) -> Aligned:
    """Move poses to where the crops look most like the templates.

    Args:
        maps: Of all crops.
        crop: In which of them each pose is looked at.
        points: Object frame, diameters.
        wanted: Descriptors of the points.
        start: Poses to begin with.
        focal_px: Of each pose's crop, whose principal point is their middle.
        num_steps: How many steps to take.
    """
    rotation, position = start.rotation, start.position
    for _ in range(num_steps):
        step = _step(maps, crop, points, wanted, rotation, position, focal_px)
        rotation, position = turn(step[:, :3]) @ rotation, position + step[:, 3:]
    here = maps.around(crop, InCrop.of(rotation, position, points).cells(focal_px, maps.side)).of(maps.here)
    cosine = (here * wanted).sum(dim=-1) / here.square().sum(dim=-1).clamp(min=1e-12).sqrt()
    return Aligned(rotation, position, cosine.mean(dim=1))


class InCrop(NamedTuple):
    """Points in the cameras of their crops; the points are last, which exported graphs compute quickest."""

    arm: Float[Tensor, "batch 3 points"]
    """From the object's centre to the points, diameters."""
    slope: Float[Tensor, "batch 2 points"]
    """Columns and rows, divided by the focal length, from the middle of the crop."""
    nearness: Float[Tensor, "batch 1 points"]
    """One over the distance along the optical axis."""

    @classmethod
    def of(
        cls,
        rotation: Float[Tensor, "batch 3 3"],
        position: Float[Tensor, "batch 3"],
        points: Float[Tensor, "batch points 3"],
    ) -> "InCrop":
        """Points of objects in poses, diameters."""
        arm = rotation @ points.transpose(1, 2)
        across, along = (arm + position[..., None]).split((2, 1), dim=1)
        nearness = 1 / along.clamp(min=_NEAREST)
        return cls(arm, across * nearness, nearness)

    def cells(self, focal_px: Float[Tensor, " batch"], side: int) -> Float[Tensor, "batch 2 points"]:
        """Columns and rows of a map of ``side`` cells."""
        middle = (side * FINE_STRIDE - 1) / 2
        return self.slope * (focal_px / FINE_STRIDE)[:, None, None] + middle / FINE_STRIDE

    def jacobians(self, focal_px: Float[Tensor, " batch"]) -> Float[Tensor, "batch 2 6 points"]:
        """Derivatives of columns, and of rows, in cells, by a rotation vector and by a shift."""
        by_arm, by_shift = (self.arm.new_tensor(values) for values in (_BY_ARM, _BY_SHIFT))
        of_across, of_along = (by_arm @ self.arm + by_shift).unflatten(1, (3, 6)).split((2, 1), dim=1)
        scale = self.nearness * (focal_px / FINE_STRIDE)[:, None, None]
        return (of_across - self.slope.unsqueeze(2) * of_along) * scale.unsqueeze(1)


def _step(
    maps: FeatureMaps,
    crop: Tensor,
    points: Tensor,
    wanted: Tensor,
    rotation: Tensor,
    position: Tensor,
    focal_px: Tensor,
) -> Float[Tensor, "batch 6"]:
    """A rotation vector about the object's centre, then a shift in diameters."""
    seen = InCrop.of(rotation, position, points)
    corners = maps.around(crop, seen.cells(focal_px, maps.side))
    here, across, down = (corners.of(values) for values in (maps.here, maps.across, maps.down))
    lacking = wanted - here
    weight = 1 / (1 + lacking.square().sum(dim=-1) / _OUTLIER).square()
    # Normal equations of each point's place, two by two and a right side, then those of the pose that moves all places.
    pairs = (across, across), (across, down), (across, down), (down, down), (across, lacking), (down, lacking)
    products = torch.stack([(one * other).sum(dim=-1) for one, other in pairs], dim=1)
    of_places, right = products.split((4, 2), dim=1)
    by_pose = seen.jacobians(focal_px / 2)  # the maps hold twice the derivatives
    left = (of_places.unflatten(1, (2, 2)).unsqueeze(3) * by_pose.unsqueeze(1)).sum(dim=2)
    equations = torch.cat([left, right.unsqueeze(2)], dim=2).transpose(2, 3)
    normal = ((by_pose * weight[:, None, None]) @ equations).sum(dim=1)
    step = solve_augmented(_damped(normal))
    length = step.square().sum(dim=1, keepdim=True).clamp(min=1e-12).sqrt()
    return step * (_LARGEST_STEP / length).clamp(max=1)


def _damped(system: Float[Tensor, "batch 6 7"]) -> Float[Tensor, "batch 6 7"]:
    """Normal equations, the right side last, with a heavier diagonal."""
    identity = torch.eye(6, 7, dtype=system.dtype, device=system.device)
    mean = (system * identity).sum(dim=(1, 2), keepdim=True) / 6
    return system * (1 + _DAMPING * identity) + _RIDGE * (1 + mean) * identity
