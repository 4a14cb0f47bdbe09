"""Grid of cells over the images of one camera: from positions in the world to cells, and back."""

import math
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from torch import Tensor, nn

from curio_train.geometry import Pose
from curio_train.scene_code import Field

STRIDE = 8
"""Pixels between cells; the centre of cell i is pixel i * STRIDE."""

_LEAST_DEPTH_M = 1e-3
_LEAST_DESCENT = 0.02  # of a ray's length: rays nearer to the horizon meet the plane too far away


def per_cell(name: str) -> str:
    """The key of a field's values at all cells, beside the scene code."""
    return f"cell_{name}"


class SplatWeights(NamedTuple):
    """The four cells around each of a number of points, with bilinear weights."""

    cell: Int[Tensor, "*batch 4"]
    """Indices of the cells, row after row."""
    weight: Float[Tensor, "*batch 4"]
    """Sum to 1 for each point."""


class CellGrid(nn.Module):
    """Cells of one camera's images."""

    def __init__(
        self, field: Field, matrix: np.ndarray, cam_from_world: Pose, size: tuple[int, int], *, on_plane: bool
    ) -> None:
        """Lay the grid.

        Args:
            field: The position, with a range; its frame is the world.
            matrix: K [3, 3], pixels.
            cam_from_world: Pose of the camera, in numpy.
            size: Width and height of the images, pixels.
            on_plane: Parametrise the points of a pixel's ray by their height y, else by their distance.
        """
        super().__init__()
        width, height = size
        self.columns, self.rows = math.ceil(width / STRIDE), math.ceil(height / STRIDE)
        self._on_plane = on_plane
        row, column = np.meshgrid(np.arange(self.rows), np.arange(self.columns), indexing="ij")
        corners = np.stack(np.meshgrid(*zip(field.lower, field.upper, strict=True)), axis=-1).reshape(-1, 3)
        depth = cam_from_world.apply(corners)[:, 2]
        low, high = (field.lower[1], field.upper[1]) if on_plane else (depth.min(), depth.max())
        self._middle, self._half = (low + high) / 2, (high - low) / 2
        self.pixels = self._constant(np.stack([column, row], axis=-1).reshape(-1, 2) * STRIDE)
        self._matrix, self._inverse = self._constant(matrix), self._constant(np.linalg.inv(matrix))
        self._rotation, self._translation = (self._constant(part) for part in cam_from_world)
        self._lower, self._upper = self._constant(field.lower), self._constant(field.upper)

    def _constant(self, values: ArrayLike) -> nn.Buffer:
        """A buffer that moves to other devices with the network and is not saved with its weights."""
        return nn.Buffer(torch.from_numpy(np.asarray(values)).float(), persistent=False)

    def project(self, position: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        """Pixels of positions in the world frame; far outside the image, but finite, for those behind the camera."""
        in_camera = Pose[Tensor](self._rotation, self._translation).apply(position)
        homogeneous = in_camera @ self._matrix.T
        return homogeneous[..., :2] / homogeneous[..., 2:].clamp(min=_LEAST_DEPTH_M)

    def locate(self, pixels: Float[Tensor, "*batch 2"], along: Float[Tensor, "*batch 1"]) -> Float[Tensor, "*batch 3"]:
        """Positions in the world frame that project to pixels.

        Args:
            pixels: Column and row.
            along: Which point of the ray, 0 in the middle of the range and ±1 at its ends: range of the height on a
                plane, else of the distance along the optical axis.
        """
        ray = torch.cat([pixels, torch.ones_like(along)], dim=-1) @ self._inverse.T
        target = self._middle + self._half * along
        if not self._on_plane:
            position: Tensor = (ray * target - self._translation) @ self._rotation
            return position
        direction, camera = ray @ self._rotation, -self._translation @ self._rotation
        steps = (target - camera[1]) / direction[..., 1:2].clamp(max=-_LEAST_DESCENT)
        span = self._upper - self._lower
        return (camera + steps * direction).clamp(self._lower - span, self._upper + span)

    def splat_weights(self, pixels: Float[Tensor, "*batch 2"]) -> SplatWeights:
        """The four cells around each pixel; the nearest ones for pixels outside the image."""
        last = pixels.new_tensor([self.columns - 1, self.rows - 1])
        position = (pixels / STRIDE).clamp(pixels.new_zeros(2), last - 1e-3)
        first = position.floor()
        remainder = position - first
        cells, weights = [], []
        for down in (0, 1):
            for right in (0, 1):
                column, row = (first + first.new_tensor([right, down])).unbind(-1)
                cells.append((row * self.columns + column).long())
                near = torch.where(first.new_tensor([right, down]) > 0, remainder, 1 - remainder)
                weights.append(near.prod(dim=-1))
        return SplatWeights(torch.stack(cells, dim=-1), torch.stack(weights, dim=-1))


def heat_map_loss(logits: Float[Tensor, "batch cells"], splat: SplatWeights) -> Float[Tensor, " batch"]:
    """Cross entropy between a predicted centre heat map and the true one, summed over the cells.

    Args:
        logits: Of the heat map.
        splat: Cells around the true objects' centres, [batch, objects, 4].
    """
    target = torch.zeros_like(logits).scatter_add(1, splat.cell.flatten(1), splat.weight.flatten(1))
    return F.binary_cross_entropy_with_logits(logits, target.clamp(max=1), reduction="none").sum(dim=1)


def gather_cells(
    values: Float[Tensor, "batch cells size"], splat: SplatWeights
) -> Float[Tensor, "batch objects 4 size"]:
    """Values at the four cells around each object."""
    picked = values.gather(1, splat.cell.flatten(1)[..., None].expand(-1, -1, values.shape[-1]))
    return picked.unflatten(1, splat.cell.shape[1:])
