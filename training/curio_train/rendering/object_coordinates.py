"""Which point of an object each patch of an image sees: the renderer, with coordinates for colours."""

import dataclasses

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from curio_train.color import linear_from_srgb
from curio_train.meshes.gltf import srgb_from_linear
from curio_train.meshes.meshes import Mesh
from curio_train.rendering.renderer import Renderer

_MIDDLE, _REACH = 0.55, 0.4
"""Coordinates are stored as linear colours from 0.15 to 0.95: never 0, which is where nothing is seen."""

_LEAST_SEEN = 0.5  # of a patch's area
_ALMOST_DARK = torch.tensor([[0.0, 0.0, -1e-6]])  # surfaces show their own colour, under ambient light alone


class ObjectCoordinateMap:
    """Renders the surface of a mesh in its own coordinates."""

    center_m: np.ndarray
    """Middle of the mesh's box, [3]."""
    half_extent_m: float
    """Half of its longest side: what a coordinate of 1 means."""

    def __init__(self, mesh: Mesh, side: int) -> None:
        """Build for images of ``side`` x ``side`` patches."""
        lower, upper = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
        self.center_m, self.half_extent_m = (lower + upper) / 2, float((upper - lower).max() / 2)
        linear = _MIDDLE + _REACH * (mesh.vertices_m - self.center_m) / self.half_extent_m
        painted = dataclasses.replace(
            mesh, vertex_colors_srgb=srgb_from_linear(linear), uv=None, texture=None, sha256=""
        )
        self._renderer = Renderer([painted], [0], side, side, ambient=1.0)

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
            Coordinates in half extents from the middle of the box, −1 to 1, of what a patch sees of the object however
            little that is; where it is not seen they mean nothing. And where it fills half of a patch or more.
        """
        colors, alpha = self._renderer.cutouts(
            rotation[:, None], translation_m[:, None], camera_matrix=matrices, lights=_ALMOST_DARK
        )
        alpha = alpha.clamp(min=1e-3)
        linear = linear_from_srgb((colors[0] / alpha).clamp(0, 1))
        return (linear - _MIDDLE) / _REACH, alpha[:, 0] >= _LEAST_SEEN
