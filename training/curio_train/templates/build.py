"""A template network made from a mesh: templates drawn, described and compressed; nothing is trained."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from curio_train.errors import UsageError
from curio_train.meshes.inset import inset
from curio_train.meshes.meshes import Mesh
from curio_train.rendering.object_coordinates import ObjectCoordinateMap
from curio_train.templates.bank import NUM_POINTS, RANK, Bank
from curio_train.templates.drawing import APPEARANCES, CropTemplateRenderer, TemplateRenderer
from curio_train.templates.geometry import (
    CROP_PX,
    FILL,
    FRAME_STRIDE,
    LOCALISING_ROLLS,
    LOCALISING_VIEWS,
    Geometry,
    viewpoints,
)
from curio_train.templates.localiser import RANK as LOCALISING_RANK
from curio_train.templates.localiser import Localiser
from curio_train.templates.network import TemplateNetwork
from curio_train.templates.trunk import COARSE_STRIDE, FINE_STRIDE, Trunk
from curio_train.worlds.base import World
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.viewpoints import upper_hemisphere_rotations
from curio_train.worlds.single_object.world import SingleObjectWorld

_NUM_FRAMES, _NUM_CROPS = 24, 256  # of backgrounds
_SEED = 20_211
_BATCH = 64  # of drawings
_FEATURES_BATCH = 8  # of pictures: larger feature maps are allocated anew each time, which takes five times as long
_PAD_CELLS = 2  # around localising templates, so that no kernel sees the picture's border
_INSIDE = 0.98  # of the pixels around a surface point show the object


def template_network(world: World) -> TemplateNetwork:
    """A network for a world's frames and object, empty until :func:`fill` or a checkpoint fills it.

    Raises:
        UsageError: The world is not of one object that is read in two stages, or templates cannot show the object.
    """
    if not isinstance(world, TwoStageWorld):
        raise UsageError(
            f"--method templates finds one object in six degrees of freedom, which {world.name} does not ask for here: "
            "expected linemod without --no-gaze, or capture without --plane"
        )
    assert world.camera.matrix is not None
    one = world.object
    if one.unpainted or one.rotations is not upper_hemisphere_rotations:
        raise UsageError(
            f"--method templates: templates show {one.kind.name} from above and in the colours of its mesh; capture "
            "needs a mesh with colours, and --upright"
        )
    return TemplateNetwork(
        Geometry(
            world.camera.matrix,
            world.camera.width,
            world.camera.height,
            one.kind.diameter_m,
            one.near_m,
            one.far_m,
        )
    )


def without_scan_excess(world: TwoStageWorld) -> TwoStageWorld:
    """The world with its object as thick as the real one."""
    object_ = world.object
    thinner = replace(object_, mesh=inset(object_.mesh, object_.scan_excess_m), scan_excess_m=0.0)
    return TwoStageWorld(world.name, thinner, world.photographs)


@torch.no_grad()
def fill(network: TemplateNetwork, world: SingleObjectWorld, cache: Path) -> None:
    """Draw and store all templates.

    Raises:
        CheckpointError: The trunk's weights are missing or damaged.
        RendererError: The mesh cannot be rendered.
        DataError: The backgrounds cannot be read.
    """
    network.trunk.load_state_dict(Trunk.pretrained().state_dict())
    geometry = network.geometry
    backgrounds = world.backgrounds(cache).split(True)
    frames = backgrounds.draw(_NUM_FRAMES, geometry.width, geometry.height, (_SEED, 0))
    mesh = world.object.mesh
    _fill_localiser(network.localiser, network.trunk, geometry, mesh, frames)
    width_m = geometry.width / geometry.focal_px  # of a frame at a distance of 1 m
    least, largest = (geometry.diameter_m / FILL / (width_m * depth) for depth in (geometry.far_m, geometry.near_m))
    crops = backgrounds.of_crops(least, largest).draw(_NUM_CROPS, CROP_PX, CROP_PX, (_SEED, 1))
    _fill_bank(network.bank, network.trunk, geometry, mesh, crops)


def _fill_localiser(localiser: Localiser, trunk: Trunk, geometry: Geometry, mesh: Mesh, frames: Tensor) -> None:
    """Templates over grey at every distance, whitened by the backgrounds, then their scores there."""
    background = torch.cat([trunk(F.avg_pool2d(frame[None], FRAME_STRIDE))[1] for frame in frames])
    whitening = localiser.descriptors.whiten(background)
    rotations = viewpoints(LOCALISING_VIEWS, LOCALISING_ROLLS)
    features, masks = [], []
    for depth in geometry.depths_m:
        cells = geometry.kernel_cells(depth)
        side = (cells + 2 * _PAD_CELLS - 1) * COARSE_STRIDE + 1
        renderer = TemplateRenderer(mesh, depth, geometry.focal_px / FRAME_STRIDE, side)
        drawn = [renderer.draw(some) for some in rotations.split(_BATCH)]
        kernel = slice(_PAD_CELLS, _PAD_CELLS + cells)
        seen = torch.cat([_features(trunk, some.over(0, torch.tensor(0.5)))[1] for some in drawn])
        alpha = torch.cat([some.alpha for some in drawn])
        features.append(seen[:, :, kernel, kernel])
        masks.append(alpha[:, :, ::COARSE_STRIDE, ::COARSE_STRIDE][:, :, kernel, kernel])
    flat = torch.cat([of_depth.flatten(2) for of_depth in features], dim=2)[..., None]
    mask = torch.cat([of_depth.flatten(2) for of_depth in masks], dim=2)[..., None]
    localiser.descriptors.compress(whitening, flat, mask)
    for number, (of_depth, covered) in enumerate(zip(features, masks, strict=True)):
        templates = _mean_cosine(localiser.descriptors(of_depth), covered)
        filters, weights = _low_rank(templates, LOCALISING_RANK)
        localiser.filters(number).copy_(filters)
        localiser.weights[number].copy_(weights)
    _standardise(localiser, localiser.descriptors(background))


def _standardise(localiser: Localiser, descriptors: Tensor) -> None:
    """Scale and shift all scores so that each template's have mean 0 and standard deviation 1 on background."""
    localiser.offsets.zero_()
    scores = [torch.stack(of_image) for of_image in zip(*(localiser.scores(d[None]) for d in descriptors), strict=True)]
    for number, of_depth in enumerate(scores):  # [images, 1, templates, cells]
        spread, mean = torch.std_mean(of_depth, dim=(0, 1, 3))
        localiser.weights[number] /= spread[:, None].clamp(min=1e-6)
        localiser.offsets[number] = -mean / spread.clamp(min=1e-6)


def _fill_bank(bank: Bank, trunk: Trunk, geometry: Geometry, mesh: Mesh, crops: Tensor) -> None:
    """Descriptors averaged over lamps and backgrounds: what changes with either counts less."""
    depth, random = geometry.typical_m, np.random.default_rng(_SEED)
    focal_px = FILL * CROP_PX * depth / geometry.diameter_m
    renderer = CropTemplateRenderer(mesh, depth, geometry.focal_px, focal_px, CROP_PX)
    fine, coarse, alphas = [], [], []  # features of every look, batch after batch
    for rotations in bank.rotations.split(_BATCH):
        drawn = renderer.draw(rotations)
        behind = [crops[torch.from_numpy(random.integers(0, len(crops), len(rotations)))] for _ in APPEARANCES]
        seen = [_features(trunk, drawn.over(n, behind[n], exposure)) for n, (_, exposure) in enumerate(APPEARANCES)]
        fine.append(torch.stack([one for one, _ in seen]))
        coarse.append(torch.stack([one for _, one in seen]))
        alphas.append(drawn.alpha)
    fine_background, coarse_background = _features(trunk, crops)
    alpha, of_coarse = torch.cat(alphas), torch.cat(coarse, dim=1)
    covered = alpha[:, :, ::COARSE_STRIDE, ::COARSE_STRIDE]
    bank.coarse.compress(bank.coarse.whiten(coarse_background), of_coarse[0], covered)
    filters, weights = _low_rank(_mean_cosine(_sum(bank.coarse(seen) for seen in of_coarse), covered), RANK)
    bank.filters.copy_(filters)
    bank.weights.copy_(weights)
    inside = _inside(alpha)
    of_object = torch.cat([some[0] for some in fine]).movedim(1, 0)[:, inside].mean(dim=1)
    bank.fine.mean.copy_((fine_background.mean(dim=(0, 2, 3)) + of_object) / 2)
    described = torch.cat([F.normalize(_sum(bank.fine(seen) for seen in some), dim=1) for some in fine])
    points = _surface_points(mesh, bank.rotations, depth, focal_px)
    _store_points(bank, inside, described, points / geometry.diameter_m)


def _features(trunk: Trunk, pictures: Tensor) -> tuple[Tensor, Tensor]:
    fine, coarse = zip(*(trunk(some) for some in pictures.split(_FEATURES_BATCH)), strict=True)
    return torch.cat(fine), torch.cat(coarse)


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


def _store_points(bank: Bank, inside: Tensor, described: Tensor, points: Tensor) -> None:
    """A random choice of each template's cells, all of them and some twice where they are few."""
    random, chosen = np.random.default_rng(_SEED), []
    for mask in inside.flatten(1).numpy():
        cells = random.permutation(np.flatnonzero(mask))
        chosen.append(np.resize(cells, NUM_POINTS))
    index = torch.from_numpy(np.stack(chosen))[:, None]
    of_cells = (
        values.flatten(2).gather(2, index.expand(-1, values.shape[1], -1)).transpose(1, 2)
        for values in (points, described)
    )
    bank.store(*of_cells)


def _mean_cosine(descriptors: Tensor, mask: Float[Tensor, "templates 1 height width"]) -> Tensor:
    """Templates whose product with a picture's descriptors is the mean cosine over their silhouettes."""
    return F.normalize(descriptors, dim=1) * mask / mask.sum(dim=(1, 2, 3), keepdim=True).clamp(min=1e-6)


def _low_rank(templates: Float[Tensor, "templates size height width"], rank: int) -> tuple[Tensor, Tensor]:
    """Filters [rank, size, height, width] and weights [templates, rank] whose products are nearly the templates."""
    rows = templates.flatten(1)
    _, vectors = torch.linalg.eigh(rows @ rows.T)  # the largest are last
    weights = vectors[:, -rank:]
    return (weights.T @ rows).unflatten(1, templates.shape[1:]), weights
