"""Which point of an object each patch of an image sees: the renderer, with coordinates for colours."""

import dataclasses

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from curio_train.data.meshes import Mesh
from curio_train.rendering.renderer import Renderer, linear_from_srgb

_MIDDLE, _REACH = 0.55, 0.4
"""Coordinates are stored as linear colours from 0.15 to 0.95: never 0, which is where nothing is seen."""

_LEAST_SEEN = 0.1


class SurfaceMap:
    """Renders the surface of a mesh in its own coordinates.

    Attributes:
        center_m: Middle of the mesh's box, [3].
        half_extent_m: Half of its longest side: what a coordinate of 1 means.
    """

    def __init__(self, mesh: Mesh, side: int) -> None:
        """Build for images of ``side`` x ``side`` patches."""
        lower, upper = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
        self.center_m, self.half_extent_m = (lower + upper) / 2, float((upper - lower).max() / 2)
        linear = _MIDDLE + _REACH * (mesh.vertices_m - self.center_m) / self.half_extent_m
        painted = dataclasses.replace(
            mesh, vertex_colors_srgb=_srgb_from_linear(linear), uv=None, texture=None, sha256=""
        )
        self._renderer = Renderer([painted], [0], side, side, ambient=1.0)
        self._side = side

    @torch.no_grad()
    def __call__(
        self, rotation: Float[Tensor, "batch 3 3"], translation_m: Float[Tensor, "batch 3"], matrices: np.ndarray
    ) -> tuple[Float[Tensor, "batch 3 side side"], Bool[Tensor, "batch side side"]]:
        """Points of the object that patches see, and which patches see it.

        Args:
            rotation: cam_from_obj.
            translation_m: cam_from_obj.
            matrices: K of each image, [batch, 3, 3], in patches.

        Returns:
            Coordinates in half extents from the middle of the box, −1 to 1; where the object is not seen they mean
            nothing.
        """
        count = len(rotation)
        image = self._renderer(
            rotation[:, None],
            translation_m[:, None],
            camera_matrix=matrices,
            backgrounds=translation_m.new_zeros(count, 3, self._side, self._side),
            light=translation_m.new_tensor([[0.0, 0.0, -1e-6]]).expand(count, 3),
        )
        linear = linear_from_srgb(image)
        return (linear - _MIDDLE) / _REACH, linear.amin(dim=1) > _LEAST_SEEN


def _srgb_from_linear(linear: np.ndarray) -> np.ndarray:
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
