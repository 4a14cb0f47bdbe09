"""Small trials of the renderer and of training, to be run in a process of their own."""

import time
from pathlib import Path

import numpy as np
import torch

from curio_train.camera import Intrinsics, square_matrix
from curio_train.config import RunConfig, preset_recipe
from curio_train.data.backgrounds import POOL_HEIGHT, POOL_WIDTH, ClutterBackgrounds
from curio_train.errors import RendererError
from curio_train.learning.hardware import choose_threads
from curio_train.learning.parallel import Ranks
from curio_train.learning.trainer import Trainer
from curio_train.meshes.shapes import box, sphere
from curio_train.rendering.renderer import Renderer
from curio_train.worlds import WORLDS, build
from curio_train.worlds.base import ImageSource, ObjectKind, StagedWorld, World, stages_of
from curio_train.worlds.image_sets import StoredImages
from curio_train.worlds.options import LinemodOptions
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.world import Object, SingleObjectWorld

_SMALL_PX = 32
_STEPS, _NUM_IMAGES = 3, 64


def render_a_box() -> float:
    """Fraction of the pixels that a white box covers whose face fills a quarter of the picture.

    Raises:
        RendererError: The picture shows something else.
    """
    renderer = Renderer([box((1.0, 1.0, 0.01))], [0], _SMALL_PX, _SMALL_PX, ambient=1.0)
    picture = renderer(
        torch.eye(3)[None, None],
        torch.tensor([[[0.0, 0.0, 2.005]]]),
        camera_matrix=square_matrix(_SMALL_PX, _SMALL_PX),
        backgrounds=torch.zeros(1, 3, _SMALL_PX, _SMALL_PX),
        light=torch.zeros(1, 3),
    )
    fraction = float((picture.mean(dim=1) > 0.25).float().mean())
    if not 0.24 <= fraction <= 0.26:
        raise RendererError(f"the test picture's box covers {fraction:.1%} of it, expected 25 %")
    return fraction


def images_per_second(name: str) -> float:
    """Images a second of training a world as ``curio-train NAME`` does by default, as quick as the CPU is now.

    Of worlds that read files the object is a sphere of 20,000 faces in frames of 640x480 pixels.
    """
    kind = WORLDS[name]
    options = LinemodOptions("sphere", two_stage=True) if kind is LinemodOptions else kind()
    world = _sphere_over_noise() if kind is LinemodOptions else build(options)
    config = RunConfig(options, kind.default_method, recipe=preset_recipe("laptop", kind))
    sources = [_source(stage) for stage in stages_of(world)]
    trainer = Trainer(config, world, sources, Ranks(0, 1, torch.device("cpu")))
    choose_threads(trainer.warm_up)
    steps = len(world.stage_schedule) if isinstance(world, StagedWorld) else _STEPS
    with trainer.synthetic.prefetching():
        for _ in range(steps):  # compiles the kernels
            trainer.step(1.0)
        begun = time.perf_counter()
        for _ in range(2 * steps):
            trainer.step(1.0)
        seconds = time.perf_counter() - begun
        trainer.synthetic.wait_idle()
    return config.recipe.batch_size * 2 * steps / seconds


def _sphere_over_noise() -> TwoStageWorld:
    mesh = sphere(0.05, subdivisions=5)
    kind = ObjectKind("sphere", (0,), mesh.diameter_m, mesh.box_corners_m)
    noise = np.random.default_rng(0).integers(256, size=(_NUM_IMAGES, POOL_HEIGHT, POOL_WIDTH, 3), dtype=np.uint8)
    camera = Intrinsics(np.array([[600, 0, 319.5], [0, 600, 239.5], [0, 0, 1.0]]), 640, 480)
    return TwoStageWorld("linemod", Object(kind, mesh, camera, 0.5, 1.5, lambda _: ClutterBackgrounds(noise)))


def _source(stage: World) -> ImageSource:
    """As a run's, but from few images, and none that are kept."""
    if isinstance(stage, SingleObjectWorld):
        return stage.source("train", 0, with_code=False, cache=Path())
    with torch.no_grad():
        images = stage.render(stage.sample(_NUM_IMAGES, (0,)))
    return StoredImages((images.clamp(0, 1) * 255).round().byte(), None, seed=0, shuffle=True)
