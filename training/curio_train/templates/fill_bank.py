"""The templates of one object: drawn from all sides, described and compressed."""

from collections.abc import Iterable

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from curio_train.meshes.meshes import Mesh
from curio_train.networks.templates.bank import COARSE_SIZE, NUM_POINTS, RANK, Bank
from curio_train.networks.templates.descriptors import Descriptors
from curio_train.networks.templates.geometry import CROP_PX, FILL, NUM_ROLLS, NUM_VIEWS, Geometry, viewpoints
from curio_train.networks.templates.trunk import COARSE_STRIDE, COARSE_WIDTH, FINE_STRIDE, FINE_WIDTH, Trunk
from curio_train.rendering.object_coordinates import ObjectCoordinateMap
from curio_train.templates.describe import features, low_rank, mean_cosine
from curio_train.templates.drawing import APPEARANCES, CropTemplateRenderer
from curio_train.templates.outline import outlines

_SEED = 20_211
_BATCH = 64  # of drawings
_INSIDE = 0.98  # of the pixels around a surface point show the object


def filled_bank(trunk: Trunk, geometry: Geometry, mesh: Mesh, crops: Tensor) -> Bank:
    """The templates of an object: descriptors averaged over lamps and backgrounds, because what changes counts less.

    Args:
        trunk: With its weights.
        geometry: Of frames and object.
        mesh: Of the object.
        crops: Backgrounds [num, 3, CROP_PX, CROP_PX] in [0, 1].

    Raises:
        RendererError: The mesh cannot be rendered.
    """
    of_crop, of_surface = Descriptors(COARSE_WIDTH, COARSE_SIZE), Descriptors(FINE_WIDTH, FINE_WIDTH)
    views = viewpoints(NUM_VIEWS, NUM_ROLLS)
    depth, random = geometry.typical_m, np.random.default_rng(_SEED)
    focal_px = FILL * CROP_PX * depth / geometry.diameter_m
    renderer = CropTemplateRenderer(mesh, depth, geometry.focal_px, focal_px, CROP_PX)
    fine, coarse, alphas = [], [], []  # features of every look, batch after batch
    for rotations in views.split(_BATCH):
        drawn = renderer.draw(rotations)
        behind = [crops[torch.from_numpy(random.integers(0, len(crops), len(rotations)))] for _ in APPEARANCES]
        seen = [features(trunk, drawn.over(n, behind[n], exposure)) for n, (_, exposure) in enumerate(APPEARANCES)]
        fine.append(torch.stack([one for one, _ in seen]))
        coarse.append(torch.stack([one for _, one in seen]))
        alphas.append(drawn.alpha)
    fine_background, coarse_background = features(trunk, crops)
    alpha, of_coarse = torch.cat(alphas), torch.cat(coarse, dim=1)
    covered = alpha[:, :, ::COARSE_STRIDE, ::COARSE_STRIDE]
    of_crop.compress(of_crop.whiten(coarse_background), of_coarse[0], covered)
    filters, weights = low_rank(mean_cosine(_sum(of_crop(seen) for seen in of_coarse), covered), RANK)
    inside = _inside(alpha)
    of_object = torch.cat([some[0] for some in fine]).movedim(1, 0)[:, inside].mean(dim=1)
    of_surface.mean.copy_((fine_background.mean(dim=(0, 2, 3)) + of_object) / 2)
    described = torch.cat([F.normalize(_sum(of_surface(seen) for seen in some), dim=1) for some in fine])
    points = _surface_points(mesh, views, depth, focal_px)
    on_points, of_points = _chosen(inside, points / geometry.diameter_m, described)
    return Bank(of_crop, of_surface, filters, weights, on_points, of_points, *outlines(mesh, geometry))


def _sum(of_appearances: Iterable[Tensor]) -> Tensor:
    return torch.stack(list(of_appearances)).sum(dim=0)


def _inside(alpha: Float[Tensor, "templates 1 side side"]) -> Bool[Tensor, "templates cells cells"]:
    """Cells of stride 4 whose surroundings show nothing but the object; at least one a template."""
    around = F.avg_pool2d(alpha, 5, 1, 2)[:, 0, ::FINE_STRIDE, ::FINE_STRIDE]
    return around >= around.amax(dim=(1, 2), keepdim=True).clamp(max=_INSIDE)


def _surface_points(
    mesh: Mesh, rotations: Tensor, depth_m: float, focal_px: float
) -> Float[Tensor, "templates 3 cells cells"]:
    """The point of the object, metres, that the centre of each cell of stride 4 sees."""
    surface = ObjectCoordinateMap(mesh, CROP_PX)
    middle = (CROP_PX - 1) / 2
    matrix = np.array([[focal_px, 0, middle], [0, focal_px, middle], [0, 0, 1]])
    position = torch.tensor([0.0, 0.0, depth_m])
    found = [
        surface(some, position.expand(len(some), 3), np.broadcast_to(matrix, (len(some), 3, 3)))[0][
            :, :, ::FINE_STRIDE, ::FINE_STRIDE
        ]
        for some in rotations.split(_BATCH)
    ]
    return torch.cat(found) * surface.half_extent_m + torch.from_numpy(surface.center_m).float()[:, None, None]


def _chosen(
    inside: Bool[Tensor, "templates cells cells"], *of_cells: Float[Tensor, "templates size cells cells"]
) -> list[Float[Tensor, "templates points size"]]:
    """Values at a random choice of each template's cells, all of them and some twice where they are few."""
    random, chosen = np.random.default_rng(_SEED), []
    for mask in inside.flatten(1).numpy():
        cells = random.permutation(np.flatnonzero(mask))
        chosen.append(np.resize(cells, NUM_POINTS))
    index = torch.from_numpy(np.stack(chosen))[:, None]
    return [values.flatten(2).gather(2, index.expand(-1, values.shape[1], -1)).transpose(1, 2) for values in of_cells]
