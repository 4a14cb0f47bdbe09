"""The outlines of an object seen from all sides: points on its surface, and what turns away from it there."""

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from curio_train.camera import square_matrix
from curio_train.meshes.meshes import Mesh
from curio_train.networks.templates.bank import NUM_OUTLINE_POINTS
from curio_train.networks.templates.geometry import CROP_PX, FILL, Geometry
from curio_train.rendering.object_coordinates import ObjectCoordinateMap
from curio_train.templates.drawing import TemplateRenderer

_SEED = 20_211
_BATCH = 64  # of drawings
_BLUR_PX = 5
_NEAR_EDGE = 0.15  # difference of the blurred coverage from a half
_INSIDE_PX = 2.5  # from the outline, where its distance is read


class Outlines(NamedTuple):
    """One outline a direction, which rolls of the camera do not change."""

    points: Float[Tensor, "views points 3"]
    """Object frame, diameters."""
    outward: Float[Tensor, "views points 3"]
    """Unit vectors across the line of sight, object frame."""


def outlines(mesh: Mesh, geometry: Geometry, num_points: int = NUM_OUTLINE_POINTS) -> Outlines:
    """Points of the outline in each viewing direction, drawn at random; of a short outline some are drawn twice.

    Args:
        mesh: Of the object.
        geometry: Says from where it is seen.
        num_points: In each direction.

    Raises:
        RendererError: The mesh cannot be rendered.
    """
    depth, random = geometry.typical_m, np.random.default_rng(_SEED)
    focal_px = FILL * CROP_PX * depth / geometry.diameter_m
    renderer, surface = TemplateRenderer(mesh, depth, focal_px, CROP_PX), ObjectCoordinateMap(mesh, CROP_PX)
    middle = (CROP_PX - 1) / 2
    matrix = square_matrix(focal_px, CROP_PX)
    centre = torch.tensor([0.0, 0.0, depth])
    points, outward = [], []
    for rotations in geometry.outline_rotations.split(_BATCH):
        count = len(rotations)
        matrices = np.broadcast_to(matrix, (count, 3, 3))
        coordinates, _ = surface(rotations, centre.expand(count, 3), matrices)
        seen = coordinates * surface.half_extent_m + torch.from_numpy(surface.center_m).float()[:, None, None]
        reach_m = geometry.diameter_m / 2
        distance_m = depth + torch.einsum("bi,bihw->bhw", rotations[:, 2], seen).clamp(-reach_m, reach_m)
        pixels, across = _edge_pixels(renderer.draw(rotations).alpha, random, num_points)
        column, row = (pixels - _INSIDE_PX * across).round().long().clamp(0, CROP_PX - 1).unbind(2)
        at_m = distance_m[torch.arange(count)[:, None], row, column][..., None]
        in_camera = torch.cat([(pixels - middle) / focal_px * at_m, at_m], dim=2) - centre
        points.append(in_camera @ rotations / geometry.diameter_m)
        outward.append(F.pad(across, (0, 1)) @ rotations)
    return Outlines(torch.cat(points), torch.cat(outward))


def _edge_pixels(
    alpha: Float[Tensor, "views 1 side side"], random: np.random.Generator, num_points: int
) -> tuple[Float[Tensor, "views points 2"], Float[Tensor, "views points 2"]]:
    """Places (x, y) on the outline, to fractions of a pixel, and the unit vectors out of the object there."""
    blurred = F.avg_pool2d(alpha, _BLUR_PX, 1, _BLUR_PX // 2)
    padded = F.pad(blurred, (1, 1, 1, 1), mode="replicate")[:, 0]
    slope = torch.stack([padded[:, 1:-1, 2:] - padded[:, 1:-1, :-2], padded[:, 2:, 1:-1] - padded[:, :-2, 1:-1]], dim=3)
    pixels, across = [], []
    for coverage, gradient in zip(blurred[:, 0], slope / 2, strict=True):
        beside = (coverage - 0.5).abs()
        places = (beside <= beside.min().clamp(min=_NEAR_EDGE)).nonzero()
        row, column = places[np.resize(random.permutation(len(places)), num_points)].T
        inwards = gradient[row, column]
        length = inwards.norm(dim=1, keepdim=True).clamp(min=1e-6)
        to_edge = (0.5 - coverage[row, column])[:, None] * inwards / length.square()
        pixels.append(torch.stack([column, row], dim=1) + to_edge)
        across.append(-inwards / length)
    return torch.stack(pixels), torch.stack(across)
