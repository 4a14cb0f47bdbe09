"""A template network made from a mesh: templates drawn, described and compressed; nothing is trained."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from curio_train.data.backgrounds import Backgrounds
from curio_train.errors import UsageError
from curio_train.meshes.meshes import Mesh
from curio_train.networks.outline_alignment import NUM_POINTS
from curio_train.networks.several_objects.network import ObjectsNetwork
from curio_train.networks.templates.geometry import (
    CROP_PX,
    FILL,
    FRAME_STRIDE,
    Geometry,
)
from curio_train.networks.templates.localiser import Localiser
from curio_train.networks.templates.network import TemplateNetwork
from curio_train.networks.templates.quick_trunk import quicken
from curio_train.networks.templates.trunk import COARSE_STRIDE, Trunk
from curio_train.networks.two_stage.network import TwoStageNetwork
from curio_train.templates.describe import low_rank, mean_cosine
from curio_train.templates.drawing import Drawn, TemplateRenderer
from curio_train.templates.fill_bank import filled_bank
from curio_train.templates.outline import outlines
from curio_train.threads import in_threads
from curio_train.worlds.base import World
from curio_train.worlds.several_objects.world import SeveralObjectsWorld
from curio_train.worlds.single_object.two_stage import TwoStageWorld, template_geometry
from curio_train.worlds.single_object.world import SingleObjectWorld

_NUM_FRAMES, _NUM_CROPS = 24, 256  # of backgrounds
_SEED = 20_211
_BATCH = 64  # of drawings
_PAD_CELLS = 2  # around localising templates, so that no kernel sees the picture's border


def template_network(world: World) -> TemplateNetwork:
    """A network for a world's frames and object, empty until :func:`fill` or a checkpoint fills it.

    Raises:
        UsageError: The world is not of one object that is read in two stages.
    """
    if not isinstance(world, TwoStageWorld):
        raise UsageError(
            f"--method templates finds one object in six degrees of freedom, which {world.name} does not ask for here: "
            "expected linemod with one class, or capture with one mesh and without --plane"
        )
    geometry = template_geometry(world.camera, world.object)
    return TemplateNetwork(geometry, has_color=world.object.unpainted, aligns_outlines=world.aligns_outlines)


def without_scan_excess(world: TwoStageWorld) -> TwoStageWorld:
    """The world with its object as thick as the real one."""
    return TwoStageWorld(world.name, world.object.without_scan_excess(), world.photographs)


@torch.no_grad()
def fill(network: TemplateNetwork, world: SingleObjectWorld, cache: Path, num_threads: int) -> None:
    """Draw and store all templates.

    Args:
        network: Whose templates are replaced.
        world: Of the object.
        cache: Where worlds keep their image sets.
        num_threads: In how many the trunk reads what this thread draws.

    Raises:
        CheckpointError: The trunk's weights are missing or damaged.
        RendererError: The mesh cannot be rendered.
        DataError: The backgrounds cannot be read.
    """
    network.trunk.load_state_dict(Trunk.pretrained().state_dict())
    geometry = network.geometry
    backgrounds = world.backgrounds(cache).split(True)
    frames = backgrounds.draw(_NUM_FRAMES, geometry.width, geometry.height, (_SEED, 0))
    mesh, color = world.object.mesh, world.object.typical_color
    if world.object.unpainted:
        mesh = replace(mesh, vertex_colors_srgb=np.broadcast_to(color, mesh.vertices_m.shape))
        network.color.copy_(torch.tensor(color))
    trunk = network.trunk
    quicken(trunk)
    _fill_localiser(network.localiser, trunk, geometry, mesh, frames, num_threads)
    network.reader.banks.put(0, filled_bank(trunk, geometry, mesh, _crops(backgrounds, geometry), num_threads))
    fill_outline(network, world)


@torch.no_grad()
def fill_objects(network: ObjectsNetwork, world: SeveralObjectsWorld, cache: Path, num_threads: int) -> None:
    """Draw and store templates and outlines of several objects, and load the trunk's weights; what is trained stays.

    Args:
        network: Whose templates are replaced.
        world: Of the objects.
        cache: Where worlds keep their image sets.
        num_threads: In how many the trunk reads what this thread draws.

    Raises:
        CheckpointError: The trunk's weights are missing or damaged.
        RendererError: A mesh cannot be rendered.
        DataError: The backgrounds cannot be read.
    """
    network.locator.trunk.load_state_dict(Trunk.pretrained().state_dict())
    trunk = network.locator.trunk
    quicken(trunk)
    backgrounds = world.members[0].backgrounds(cache).split(True)
    for number, (member, geometry) in enumerate(zip(world.members, network.geometries, strict=True)):
        crops = _crops(backgrounds, geometry)
        network.reader.banks.put(number, filled_bank(trunk, geometry, member.mesh, crops, num_threads))
        if network.outline is not None:
            network.outline.put(*_outlines(member.mesh, geometry), number)


@torch.no_grad()
def fill_outline(network: TwoStageNetwork | TemplateNetwork, world: SingleObjectWorld) -> None:
    """Draw the outlines that poses are aligned by, if they are.

    Raises:
        RendererError: The mesh cannot be rendered.
    """
    if network.outline is not None:
        network.outline.put(*_outlines(world.object.mesh, template_geometry(world.camera, world.object)))


def _outlines(mesh: Mesh, geometry: Geometry) -> tuple[Tensor, Tensor, Tensor]:
    """Directions, points and outward vectors of the outlines that poses are aligned by."""
    return geometry.outline_rotations[:, 2], *outlines(mesh, geometry, NUM_POINTS)


def _crops(backgrounds: Backgrounds, geometry: Geometry) -> Float[Tensor, "num 3 side side"]:
    """Backgrounds as crops around the object see them."""
    width_m = geometry.width / geometry.focal_px  # of a frame at a distance of 1 m
    least, largest = (geometry.diameter_m / FILL / (width_m * depth) for depth in (geometry.far_m, geometry.near_m))
    return backgrounds.of_crops(least, largest).draw(_NUM_CROPS, CROP_PX, CROP_PX, (_SEED, 1))


def _fill_localiser(
    localiser: Localiser, trunk: Trunk, geometry: Geometry, mesh: Mesh, frames: Tensor, num_threads: int
) -> None:
    """Templates over grey at every distance, whitened by the backgrounds, then their scores there."""
    background = trunk(F.avg_pool2d(frames, FRAME_STRIDE))[1]
    whitening = localiser.descriptors.whiten(background)
    rotations = geometry.localising_rotations
    features, masks = [], []

    def read(drawn: Drawn) -> tuple[Tensor, Tensor]:
        return trunk(drawn.over(0, torch.tensor(0.5)))[1], drawn.alpha

    for depth in geometry.depths_m:
        cells = geometry.kernel_cells(depth)
        side = (cells + 2 * _PAD_CELLS - 1) * COARSE_STRIDE + 1
        renderer = TemplateRenderer(mesh, depth, geometry.focal_px / FRAME_STRIDE, side)
        kernel = slice(_PAD_CELLS, _PAD_CELLS + cells)
        seen, alpha = zip(*in_threads(read, map(renderer.draw, rotations.split(_BATCH)), num_threads), strict=True)
        features.append(torch.cat(seen)[:, :, kernel, kernel])
        masks.append(torch.cat(alpha)[:, :, ::COARSE_STRIDE, ::COARSE_STRIDE][:, :, kernel, kernel])
    flat = torch.cat([of_depth.flatten(2) for of_depth in features], dim=2)[..., None]
    mask = torch.cat([of_depth.flatten(2) for of_depth in masks], dim=2)[..., None]
    localiser.descriptors.compress(whitening, flat, mask)
    for number, (of_depth, covered) in enumerate(zip(features, masks, strict=True)):
        templates = mean_cosine(localiser.descriptors(of_depth), covered)
        filters, weights = low_rank(templates, localiser.weights.shape[2])
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
