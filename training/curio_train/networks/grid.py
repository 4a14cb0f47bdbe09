"""Cells of an image and the places they look at: between positions in the world and pixels of its camera, both ways."""

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
"""Pixels between cells; cell i looks at pixel i * STRIDE."""

_LEAST_DEPTH_M = 1e-3
_LEAST_DESCENT = 0.02  # of a ray's length: rays nearer to the horizon meet the plane too far away


def of_cells(name: str) -> str:
    """Under which a field's values at all cells stand."""
    return f"cell_{name}"


class Share(NamedTuple):
    """The cells around points, and how much of a point each has.

    Attributes:
        cell: [*batch, 4].
        weight: [*batch, 4], bilinear; sums to 1.
    """

    cell: Int[Tensor, "*batch 4"]
    weight: Float[Tensor, "*batch 4"]


class CellGrid(nn.Module):
    """Cells of one camera's images."""

    def __init__(
        self, field: Field, matrix: np.ndarray, cam_from_world: Pose, size: tuple[int, int], *, on_plane: bool
    ) -> None:
        """Lay the grid.

        Args:
            field: The position, with a range; its frame is the world.
            matrix: K [3, 3], pixels.
            cam_from_world: Where the camera stands.
            size: Width and height of the images, pixels.
            on_plane: Places are found where a pixel's ray has their height y; else by their distance.
        """
        super().__init__()
        width, height = size
        self.columns, self.rows = math.ceil(width / STRIDE), math.ceil(height / STRIDE)
        self._on_plane = on_plane
        row, column = np.meshgrid(np.arange(self.rows), np.arange(self.columns), indexing="ij")
        turn, shift = (np.asarray(part) for part in cam_from_world)
        corners = np.stack(np.meshgrid(*zip(field.lower, field.upper, strict=True)), axis=-1).reshape(-1, 3)
        depth = (corners @ turn.T + shift)[:, 2]
        low, high = (field.lower[1], field.upper[1]) if on_plane else (depth.min(), depth.max())
        self._middle, self._half = (low + high) / 2, (high - low) / 2
        self.pixels = self._constant(np.stack([column, row], axis=-1).reshape(-1, 2) * STRIDE)
        self._matrix, self._inverse = self._constant(matrix), self._constant(np.linalg.inv(matrix))
        self._turn, self._shift = self._constant(turn), self._constant(shift)
        self._lower, self._upper = self._constant(field.lower), self._constant(field.upper)

    def _constant(self, values: ArrayLike) -> nn.Buffer:
        """It moves to other devices with the network, and is no part of its weights."""
        return nn.Buffer(torch.from_numpy(np.asarray(values)).float(), persistent=False)

    def project(self, position: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        """Pixels of positions in the world frame; far off, but finite, for those that are not before the camera."""
        seen = (position @ self._turn.T + self._shift) @ self._matrix.T
        return seen[..., :2] / seen[..., 2:].clamp(min=_LEAST_DEPTH_M)

    def locate(self, pixels: Float[Tensor, "*batch 2"], along: Float[Tensor, "*batch 1"]) -> Float[Tensor, "*batch 3"]:
        """Positions in the world frame that are seen at pixels.

        Args:
            pixels: Column and row.
            along: Which point of the ray, 0 in the middle of the range and ±1 at its ends: of height on a plane, else
                of distance along the optical axis.
        """
        ray = torch.cat([pixels, torch.ones_like(along)], dim=-1) @ self._inverse.T
        wanted = self._middle + self._half * along
        if not self._on_plane:
            position: Tensor = (ray * wanted - self._shift) @ self._turn
            return position
        direction, camera = ray @ self._turn, -self._shift @ self._turn
        steps = (wanted - camera[1]) / direction[..., 1:2].clamp(max=-_LEAST_DESCENT)
        span = self._upper - self._lower
        return (camera + steps * direction).clamp(self._lower - span, self._upper + span)

    def share(self, pixels: Float[Tensor, "*batch 2"]) -> Share:
        """The four cells around each pixel; the nearest ones for those outside the image."""
        most = pixels.new_tensor([self.columns - 1, self.rows - 1])
        place = (pixels / STRIDE).clamp(pixels.new_zeros(2), most - 1e-3)
        first = place.floor()
        part = place - first
        cells, weights = [], []
        for down in (0, 1):
            for right in (0, 1):
                column, row = (first + first.new_tensor([right, down])).unbind(-1)
                cells.append((row * self.columns + column).long())
                near = torch.where(first.new_tensor([right, down]) > 0, part, 1 - part)
                weights.append(near.prod(dim=-1))
        return Share(torch.stack(cells, dim=-1), torch.stack(weights, dim=-1))


def heat_map_loss(logits: Float[Tensor, "batch cells"], share: Share) -> Float[Tensor, " batch"]:
    """Cross entropy of how much of an object each cell is said to hold, and how much it does hold.

    Args:
        logits: Of the amounts.
        share: Of the objects, [batch, objects, 4].
    """
    wanted = torch.zeros_like(logits).scatter_add(1, share.cell.flatten(1), share.weight.flatten(1))
    return F.binary_cross_entropy_with_logits(logits, wanted.clamp(max=1), reduction="none").sum(dim=1)


def gather_cells(values: Float[Tensor, "batch cells size"], share: Share) -> Float[Tensor, "batch objects 4 size"]:
    """What the cells around each object say."""
    picked = values.gather(1, share.cell.flatten(1)[..., None].expand(-1, -1, values.shape[-1]))
    return picked.unflatten(1, share.cell.shape[1:])
