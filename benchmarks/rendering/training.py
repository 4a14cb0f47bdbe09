"""What a training step costs, and how much of it is rendering.

    python benchmarks/rendering/training.py [--json]

Steps of the paper's method (image loss and critic, the paper's networks) at batch 128 on a generated mesh, in turns:
at the precision of the laptop preset, and in plain float32. ``renderer_share`` is the time in the renderer, forward and
backward, over the time of the step as trained; ``loss_difference`` is the largest relative difference of the two image
losses over the steps, from the same weights.
"""

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from curio_train.config import PRESETS, NetworkConfig, RunConfig, WorldOptions
from curio_train.geometry import matrix_from_rotation_6d, random_rotations, rotation_6d_from_matrix
from curio_train.learning.parallel import Ranks
from curio_train.learning.trainer import Trainer
from curio_train.meshes.meshes import Mesh
from curio_train.meshes.shapes import sphere
from curio_train.rendering.renderer import Renderer
from curio_train.scene_code import LIGHT, ROTATION_6D, TRANSLATION, Field, Layout, SceneCode
from curio_train.worlds.base import Batch, Camera, ImageSource, ObjectKind, Split, World
from torch import Tensor

BATCH = 128
SIDE = 128
AMBIENT = 0.3
CAMERA = np.array([[160.0, 0, 63.5], [0, 160.0, 63.5], [0, 0, 1]])


def lump(subdivisions: int) -> Mesh:
    """An asymmetric, coloured object of about 0.1 m."""
    ball = sphere(0.05, subdivisions)
    vertices = ball.vertices_m * (1 + 0.3 * np.sin(60 * ball.vertices_m[:, :1]) + 4 * ball.vertices_m[:, 2:])
    return Mesh(vertices, ball.faces, 0.5 + 0.5 * np.sin(40 * vertices + np.arange(3)))


class LumpWorld(World):
    """One free object over black, its renderer timed."""

    name = "lump"
    camera = Camera(SIDE, SIDE, CAMERA)
    layout = Layout(
        (
            Field(TRANSLATION, 3, unit="m", frame="camera", lower=(-0.1, -0.1, 0.25), upper=(0.1, 0.1, 0.65)),
            Field(ROTATION_6D, 6, frame="camera", lower=(-1.0,) * 6, upper=(1.0,) * 6),
            Field(LIGHT, 3, per_object=False, frame="camera", lower=(-1.0,) * 3, upper=(1.0,) * 3),
        )
    )

    def __init__(self, mesh: Mesh) -> None:
        self.objects = (ObjectKind("lump", (0,), mesh.diameter_m, mesh.box_corners_m),)
        self._renderer = Renderer([mesh], [0], SIDE, SIDE, ambient=AMBIENT)
        self.seconds = 0.0

    def sample(self, count: int, seed: tuple[int, ...]) -> dict[str, Tensor]:
        random = np.random.default_rng(seed)
        position = random.uniform([-0.05, -0.05, 0.28], [0.05, 0.05, 0.55], (count, 3))
        light = random.normal(size=(count, 3)) * [0.6, 0.6, 0.2] - [0, 0, 0.6]
        return {
            TRANSLATION: torch.from_numpy(position).float()[:, None],
            ROTATION_6D: rotation_6d_from_matrix(random_rotations(count, random))[:, None],
            LIGHT: torch.from_numpy(light).float(),
        }

    def render(self, code: SceneCode, backgrounds: Tensor | None = None) -> Tensor:
        begun = time.perf_counter()
        position = code[TRANSLATION].float()
        image = self._renderer(
            matrix_from_rotation_6d(code[ROTATION_6D].float()),
            position,
            camera_matrix=CAMERA,
            backgrounds=torch.zeros(len(position), 3, SIDE, SIDE) if backgrounds is None else backgrounds,
            light=code[LIGHT].float(),
        )
        self.seconds += time.perf_counter() - begun
        if image.grad_fn is not None:
            # Hooks on the output's and the inputs' gradients bracket the renderer's own backward pass.
            mark = [0.0]
            image.register_hook(lambda _: mark.__setitem__(0, time.perf_counter()))
            position.register_hook(lambda _: self._add(mark[0]))
        return image

    def _add(self, begun: float) -> None:
        self.seconds += time.perf_counter() - begun

    def source(self, split: Split, seed: int, *, with_code: bool, cache: Path) -> "LumpImages":
        return LumpImages(self)


class LumpImages(ImageSource):
    """A few batches, rendered once, so that data costs nothing in the timing."""

    def __init__(self, world: LumpWorld) -> None:
        with torch.no_grad():
            self._images = [world.render(world.sample(BATCH, (n,))) for n in range(4)]

    def batch(self, step: int, size: int) -> Batch:
        return Batch(self._images[step % len(self._images)][:size])


def measure(world: LumpWorld, precision: str, steps: int) -> tuple[list[float], float, float]:
    """Image losses, seconds of the steps, and of the renderer in them."""
    from dataclasses import replace

    recipe = replace(PRESETS["laptop"], batch_size=BATCH, micro_batch_size=BATCH, precision=precision)
    config = RunConfig(WorldOptions(), method="our", recipe=recipe, network=NetworkConfig())
    source = world.source("train", 0, with_code=False, cache=Path())
    trainer = Trainer(config, world, [source], Ranks(0, 1, torch.device("cpu")))
    trainer.step(1.0)  # compiles the kernels
    world.seconds, begun = 0.0, time.perf_counter()
    losses = [trainer.step(1.0)["image"] for _ in range(steps)]
    return losses, time.perf_counter() - begun, world.seconds


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object on the last line")
    parser.add_argument("--steps", type=int, default=6, help="timed steps a round")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--subdivisions", type=int, default=4, help="faces: 20 times 4 to this power")
    arguments = parser.parse_args()
    mesh = lump(arguments.subdivisions)
    world = LumpWorld(mesh)
    rounds: list[dict[str, Any]] = []
    for _ in range(arguments.rounds):
        losses, seconds, rendering = measure(world, "bfloat16", arguments.steps)
        plain_losses, plain_seconds, _ = measure(world, "float32", arguments.steps)
        difference = np.abs(np.array(losses) / np.array(plain_losses) - 1).max()
        shown = BATCH * arguments.steps
        rounds.append(
            {
                "images_per_s": shown / seconds,
                "plain_images_per_s": shown / plain_seconds,
                "renderer_share": rendering / seconds,
                "loss_difference": float(difference),
            }
        )
    result: dict[str, Any] = {key: float(np.median([r[key] for r in rounds])) for key in rounds[0]}
    result |= {
        "speedup": float(np.median([r["images_per_s"] / r["plain_images_per_s"] for r in rounds])),
        "faces": len(mesh.faces),
        "batch": BATCH,
        "torch_threads": torch.get_num_threads(),
        "machine": f"{os.cpu_count()} cores",
        "rounds": rounds,
    }
    if not arguments.json:
        for name, value in result.items():
            print(f"{name:>20}  {value}")
    print(json.dumps(result))


if __name__ == "__main__":
    main()
