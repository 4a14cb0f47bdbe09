"""A pose aligned with a crop by features at surface points: no rendering, six unknowns (as in FoundPose, 2024).

Levenberg–Marquardt on the distance between the descriptor that a template has at a surface point and the one that the
crop has where the pose projects it, with a robust weight for each point. All of it is plain tensor arithmetic, so that
it can be part of an exported graph.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from curio_train.networks.pose_steps import solve, turn
from curio_train.networks.templates.trunk import FINE_STRIDE, FINE_WIDTH

_DAMPING = 1e-2  # of the Hessian's diagonal
_RIDGE = 1e-6
_LARGEST_STEP = 0.2  # radians and diameters together
_OUTLIER = 0.5  # squared distance of descriptors at which a point counts a quarter (Geman and McClure 1985)


class FeatureMaps(NamedTuple):
    """Descriptors of crops, and their derivatives across and down a cell; cell (i, j) lies at crop pixel (4 i, 4 j)."""

    values: Float[Tensor, "crops*side*side 3*size"]
    """Cell after cell, row after row, crop after crop."""
    side: int
    """Cells along a side of the crop."""

    @classmethod
    def of(cls, descriptors: Float[Tensor, "crops size side side"]) -> "FeatureMaps":
        """The maps of descriptors."""
        padded = F.pad(descriptors, (1, 1, 1, 1), mode="replicate")
        across = (padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]) / 2
        down = (padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]) / 2
        together = torch.cat([descriptors, across, down], dim=1)
        return cls(together.permute(0, 2, 3, 1).flatten(0, 2), descriptors.shape[-1])

    def at(
        self, crop: Int[Tensor, " batch"], column: Float[Tensor, "batch points"], row: Float[Tensor, "batch points"]
    ) -> Float[Tensor, "batch points 3*size"]:
        """Bilinear values; those of the border where a point lies outside."""
        column, row = column.clamp(0, self.side - 1), row.clamp(0, self.side - 1)
        left, top = column.floor().clamp(max=self.side - 2), row.floor().clamp(max=self.side - 2)
        right, below = (column - left)[..., None], (row - top)[..., None]
        first = (crop[:, None] * self.side + top.long()) * self.side + left.long()
        # index_select and sums, not indexing and lerp, which take an exported graph several times as long.
        upper_left, upper_right, lower_left, lower_right = (
            self.values.index_select(0, (first + step).flatten()).unflatten(0, first.shape)
            for step in (0, 1, self.side, self.side + 1)
        )
        upper, lower = upper_left + right * (upper_right - upper_left), lower_left + right * (lower_right - lower_left)
        return upper + below * (lower - upper)


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
    _, seen = _sample(maps, crop, points, rotation, position, focal_px)
    here = seen[..., :FINE_WIDTH]
    cosine = (here * wanted).sum(dim=-1) / here.square().sum(dim=-1).clamp(min=1e-12).sqrt()
    return Aligned(rotation, position, cosine.mean(dim=1))


def _sample(
    maps: FeatureMaps, crop: Tensor, points: Tensor, rotation: Tensor, position: Tensor, focal_px: Tensor
) -> tuple[Float[Tensor, "batch points 3"], Float[Tensor, "batch points 3*size"]]:
    """Points in the crop's camera, and the maps where it sees them."""
    seen = points @ rotation.transpose(1, 2) + position[:, None]
    middle = (maps.side * FINE_STRIDE - 1) / 2
    x, y, z = seen.unbind(-1)
    scale = focal_px[:, None] / z.clamp(min=1e-3)
    return seen, maps.at(crop, (scale * x + middle) / FINE_STRIDE, (scale * y + middle) / FINE_STRIDE)


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
    seen, found = _sample(maps, crop, points, rotation, position, focal_px)
    here, across, down = found.split(FINE_WIDTH, dim=-1)
    residual = here - wanted
    weight = 1 / (1 + residual.square().sum(dim=-1) / _OUTLIER).square()
    x, y, z = seen.unbind(-1)
    scale, zero = focal_px[:, None] / FINE_STRIDE / z, torch.zeros_like(z)
    arm = seen - position[:, None]
    u = _by_pose(torch.stack([scale, zero, -scale * x / z], dim=-1), arm)
    v = _by_pose(torch.stack([zero, scale, -scale * y / z], dim=-1), arm)
    jacobian = torch.cat([u, v], dim=1)  # [batch, 2 points, 6]
    uu, uv, vv = ((a * b).sum(dim=-1) * weight for a, b in ((across, across), (across, down), (down, down)))
    of_u = uu[..., None] * u + uv[..., None] * v
    of_v = uv[..., None] * u + vv[..., None] * v
    hessian = jacobian.transpose(1, 2) @ torch.cat([of_u, of_v], dim=1)
    slope = torch.cat([(across * residual).sum(dim=-1) * weight, (down * residual).sum(dim=-1) * weight], dim=1)
    gradient = (jacobian.transpose(1, 2) @ slope[..., None])[..., 0]
    step = -solve(_damped(hessian), gradient)
    length = step.square().sum(dim=1, keepdim=True).clamp(min=1e-12).sqrt()
    return step * (_LARGEST_STEP / length).clamp(max=1)


def _by_pose(by_point: Float[Tensor, "batch points 3"], arm: Float[Tensor, "batch points 3"]) -> Tensor:
    """The derivative by rotation and shift from the one by a point's position, [batch, points, 6]."""
    return torch.cat([torch.linalg.cross(arm, by_point), by_point], dim=-1)


def _damped(hessian: Float[Tensor, "batch 6 6"]) -> Float[Tensor, "batch 6 6"]:
    identity = torch.eye(6, dtype=hessian.dtype, device=hessian.device)
    diagonal = (hessian * identity).sum(dim=2)
    return hessian + identity * (_DAMPING * diagonal + _RIDGE * (1 + diagonal.mean(dim=1, keepdim=True)))[:, None]
