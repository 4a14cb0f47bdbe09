"""The templates of one object: drawn from all sides, described and compressed."""

from collections.abc import Iterable, Iterator

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from curio_train.camera import square_matrix
from curio_train.counting import counted
from curio_train.meshes.meshes import Mesh
from curio_train.networks.templates.bank import COARSE_SIZE, NUM_POINTS, RANK, Bank
from curio_train.networks.templates.descriptors import Descriptors
from curio_train.networks.templates.geometry import CROP_PX, FILL, Geometry
from curio_train.networks.templates.trunk import COARSE_STRIDE, COARSE_WIDTH, FINE_STRIDE, FINE_WIDTH, Trunk
from curio_train.rendering.object_coordinates import ObjectCoordinateMap
from curio_train.templates.describe import low_rank, mean_cosine
from curio_train.templates.drawing import APPEARANCES, CropTemplateRenderer
from curio_train.templates.outline import outlines
from curio_train.threads import in_threads

_SEED = 20_211
_BATCH = 64  # of drawings
_INSIDE = 0.98  # of the pixels around a surface point show the object


def filled_bank(trunk: Trunk, geometry: Geometry, mesh: Mesh, crops: Tensor, num_threads: int) -> Bank:
    """The templates of an object: descriptors averaged over lamps and backgrounds, because what changes counts less.

    Args:
        trunk: With its weights.
        geometry: Of frames and object.
        mesh: Of the object.
        crops: Backgrounds [num, 3, CROP_PX, CROP_PX] in [0, 1].
        num_threads: In how many the trunk reads what this thread draws.

    Raises:
        RendererError: The mesh cannot be rendered.
    """
    of_crop, of_surface = Descriptors(COARSE_WIDTH, COARSE_SIZE), Descriptors(FINE_WIDTH, FINE_WIDTH)
    views = geometry.rotations
    depth, random = geometry.typical_m, np.random.default_rng(_SEED)
    focal_px = FILL * CROP_PX * depth / geometry.diameter_m
    renderer = CropTemplateRenderer(mesh, depth, geometry.focal_px, focal_px, CROP_PX)
    choice = _PointChoice()
    fine, coarse, covers, chosen, of_object = [], [], [], [], []  # of all templates, batch after batch

    def pictures() -> Iterator[tuple[Tensor, list[Tensor]]]:
        """Which pixels show the object, and the object before backgrounds in each appearance."""
        for rotations in views.split(_BATCH):
            drawn = renderer.draw(rotations)
            behind = [crops[torch.from_numpy(random.integers(0, len(crops), len(rotations)))] for _ in APPEARANCES]
            yield drawn.alpha, [drawn.over(n, behind[n], exposure) for n, (_, exposure) in enumerate(APPEARANCES)]

    def read(drawn: tuple[Tensor, list[Tensor]]) -> tuple[Tensor, list[tuple[Tensor, Tensor]]]:
        return drawn[0], [trunk(picture) for picture in drawn[1]]

    num_batches = -(-len(views) // _BATCH)
    for alpha, seen in counted(in_threads(read, pictures(), num_threads), num_batches, "drawing templates, batches"):
        inside = _inside(alpha)
        chosen.append(choice(inside))
        of_object.append(seen[0][0].movedim(1, 0)[:, inside])
        fine.append(torch.stack([_at(one, chosen[-1]) for one, _ in seen]))
        coarse.append(torch.stack([one for _, one in seen]))
        covers.append(alpha[:, :, ::COARSE_STRIDE, ::COARSE_STRIDE].clone())
    fine_background, coarse_background = trunk(crops)
    covered, of_coarse = torch.cat(covers), torch.cat(coarse, dim=1)
    of_crop.compress(of_crop.whiten(coarse_background), of_coarse[0], covered)
    filters, weights = low_rank(mean_cosine(_sum(of_crop(seen) for seen in of_coarse), covered), RANK)
    of_surface.mean.copy_((fine_background.mean(dim=(0, 2, 3)) + torch.cat(of_object, dim=1).mean(dim=1)) / 2)
    described = torch.cat([F.normalize(_sum(of_surface(seen) for seen in some), dim=1) for some in fine])
    points = _at(_surface_points(mesh, views, depth, focal_px), torch.cat(chosen)) / geometry.diameter_m
    of_points, on_points = described[..., 0].transpose(1, 2), points[..., 0].transpose(1, 2)
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
    matrix = square_matrix(focal_px, CROP_PX)
    position = torch.tensor([0.0, 0.0, depth_m])
    found = [
        surface(some, position.expand(len(some), 3), np.broadcast_to(matrix, (len(some), 3, 3)))[0][
            :, :, ::FINE_STRIDE, ::FINE_STRIDE
        ]
        for some in rotations.split(_BATCH)
    ]
    return torch.cat(found) * surface.half_extent_m + torch.from_numpy(surface.center_m).float()[:, None, None]


def _at(
    values: Float[Tensor, "templates size cells cells"], chosen: Int[Tensor, "templates points"]
) -> Float[Tensor, "templates size points 1"]:
    """Values at chosen cells, as a picture of one column."""
    index = chosen[:, None].expand(-1, values.shape[1], -1)
    return values.flatten(2).gather(2, index)[..., None]


class _PointChoice:
    """Chooses cells of templates at random, all of them and some twice where they are few."""

    def __init__(self) -> None:
        self._random = np.random.default_rng(_SEED)

    def __call__(self, inside: Bool[Tensor, "templates cells cells"]) -> Int[Tensor, "templates points"]:
        """Numbers of cells that lie inside, of the next templates."""
        chosen = [
            np.resize(self._random.permutation(np.flatnonzero(mask)), NUM_POINTS) for mask in inside.flatten(1).numpy()
        ]
        return torch.from_numpy(np.stack(chosen))
