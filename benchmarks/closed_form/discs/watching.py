"""Small scenes to watch learning in: one disc of any place and colour (paper, appendix, "Visualizing training").

Discs are drawn in closed form on 64x64 pixels, so that a method learns within a minute. The constants were fixed before
anything was trained:

* 5D: x, y and colour of a disc of radius 0.12 image widths. 6D: z as well; the radius is 0.18 / z, z from 1 to 3;
* positions are uniform within the frame; x and y are across the image whatever z;
* colours are drawn from a colour map, as in the paper, so that there is a distribution of colours to be learned;
* the background is dark grey.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from curio_train.config import PRESETS, ConvStack, MethodName, NetworkConfig, RunConfig, WorldOptions
from curio_train.learning.loop import learning_rate_factor
from curio_train.learning.parallel import Ranks
from curio_train.learning.trainer import Trainer
from curio_train.scene_code import COLOR, TRANSLATION, Field, Layout, SceneCode
from curio_train.worlds.base import Batch, Camera, ImageSource, ObjectKind, Split, World
from matplotlib import colormaps
from torch import Tensor

Scene = Literal["5D", "6D"]
Loss = Literal["image", "curiosity", "both"]

SIDE_PX, REACH = 64, 0.35
RADIUS, NEAR, FAR, RADIUS_AT_1 = 0.12, 1.0, 3.0, 0.18
BACKGROUND_SRGB = 0.15
_COLOR_MAP = "turbo"
_NETWORK = NetworkConfig(
    encoder=ConvStack((24, 48, 64, 96, 64), (5, 3, 3, 3, 4), (2, 2, 2, 2, 1), (2, 1, 1, 1, 0)),
    critic=ConvStack((24, 48, 64, 96, 1), (5, 3, 3, 3, 4), (2, 2, 2, 2, 1), (2, 1, 1, 1, 0)),
)


class Discs(World):
    """One disc; x right, y down, in image widths from the image's centre; z is a number that divides its size."""

    camera = Camera(SIDE_PX, SIDE_PX)
    objects = (ObjectKind("disc", (0,), 2 * RADIUS_AT_1, np.zeros((8, 3))),)

    def __init__(self, scene: Scene) -> None:
        self.name = f"discs-{scene}"
        near, far = (NEAR, FAR) if scene == "6D" else (RADIUS_AT_1 / RADIUS,) * 2
        self.layout = Layout(
            (
                Field(TRANSLATION, 3, unit="image_width", lower=(-REACH, -REACH, near), upper=(REACH, REACH, far)),
                Field(COLOR, 3, activation="sigmoid", lower=(0.0,) * 3, upper=(1.0,) * 3),
            )
        )

    def sample(self, count: int, seed: tuple[int, ...]) -> dict[str, Tensor]:
        """Uniform positions, colours from the map."""
        random = np.random.default_rng(seed)
        field = self.layout[TRANSLATION]
        position = random.uniform(field.lower, field.upper, (count, 1, 3))
        color = colormaps[_COLOR_MAP](random.random((count, 1)))[..., :3]
        return {TRANSLATION: torch.from_numpy(position).float(), COLOR: torch.from_numpy(color).float()}

    def render(self, code: SceneCode, backgrounds: Tensor | None = None) -> Tensor:
        """Each disc over dark grey, its edge a ramp of one pixel."""
        position, color = code[TRANSLATION][:, 0], code[COLOR][:, 0]
        axis = (torch.arange(SIDE_PX) - (SIDE_PX - 1) / 2) / SIDE_PX
        x, y = axis - position[:, :1], axis - position[:, 1:2]
        distance = (x.square()[:, None] + y.square()[:, :, None]).clamp_min(1e-12).sqrt()
        radius = RADIUS_AT_1 / position[:, 2].clamp(min=0.1)
        alpha = ((radius[:, None, None] - distance) * SIDE_PX + 0.5).clamp(0, 1)[:, None]
        return BACKGROUND_SRGB + alpha * (color[..., None, None] - BACKGROUND_SRGB)

    def source(self, split: Split, seed: int, *, with_code: bool, cache: Path) -> ImageSource:
        """An endless stream: nothing here is to be generalised from."""
        return _Stream(self, seed)


@dataclass(frozen=True)
class _Stream(ImageSource):
    world: Discs
    seed: int

    def batch(self, step: int, size: int) -> Batch:
        return Batch(self.world.render(self.world.sample(size, (self.seed, step))))


@dataclass(frozen=True, eq=False)
class Moment:
    """What the network makes of the images being watched, at one time.

    Attributes:
        step: Of training.
        rendered: Re-renderings [num, 3, height, width].
        read: The network as it is at that time, images to scene codes.
    """

    step: int
    rendered: Tensor
    read: Callable[[Tensor], dict[str, Tensor]]


def watch(world: Discs, loss: Loss, watched: Tensor, num_steps: int, every: int, seed: int = 0) -> Iterator[Moment]:
    """Train, looking at the same images every few steps, before the first and after the last.

    Args:
        world: Of discs.
        loss: Which terms of the paper's loss are on.
        watched: Images [num, 3, height, width].
        num_steps: Of training, 32 images each.
        every: Steps between two moments.
        seed: Of weights and images.
    """
    method: MethodName = "noncur" if loss == "image" else "our"
    laptop = PRESETS["laptop"]
    weight = 0.0 if loss == "curiosity" else laptop.image_weight
    recipe = replace(laptop, image_weight=weight, batch_size=32, micro_batch_size=32, precision="float32")
    config = RunConfig(WorldOptions(), method=method, seed=seed, recipe=recipe, network=_NETWORK)
    source = world.source("train", seed, with_code=False, cache=Path())
    trainer = Trainer(config, world, [source], Ranks(0, 1, torch.device("cpu")))
    for step in range(num_steps + 1):
        if step % every == 0:
            yield _look(trainer, watched, step)
        if step < num_steps:
            trainer.step(learning_rate_factor(recipe, step, step / num_steps))


@torch.no_grad()
def _look(trainer: Trainer, watched: Tensor, step: int) -> Moment:
    network = trainer.state.pose.network

    @torch.no_grad()
    def read(images: Tensor) -> dict[str, Tensor]:
        network.eval()
        code: dict[str, Tensor] = network(images)
        network.train()
        return code

    return Moment(step, trainer.world.render(read(watched)), read)
