"""Scenes that descend the gradient of the image loss: places and yaws lie between those of the hypotheses."""

import math
from collections.abc import Mapping

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from curio_train.scene_code import COLOR, LIGHT, TRANSLATION, YAW, SceneCode, index, joined
from curio_train.worlds.generated.hypotheses.bank import COLOR_RANGE
from curio_train.worlds.generated.mesh_world import MeshWorld

_FIRST_STEPS = {TRANSLATION: 0.02, YAW: 0.1, COLOR: 0.05, LIGHT: 0.05}  # metres, and units of the code
_NUM_STEPS, _SLOWER = 16, 0.93  # each step is so much shorter
_AT_ONCE = 50


@torch.no_grad()
def image_losses(
    world: MeshWorld, code: SceneCode, images: UInt8[Tensor, "batch 3 height width"]
) -> Float[Tensor, " batch"]:
    """Sum of squared differences between each image and its scene's rendering."""
    batches = _batches(len(images))
    return torch.cat([_losses(world, index(code, some), images[some]) for some in batches])


def descended(
    world: MeshWorld, code: SceneCode, images: UInt8[Tensor, "batch 3 height width"]
) -> tuple[dict[str, Tensor], Float[Tensor, " batch"]]:
    """The codes after some steps along the gradient, of each image those with its lowest loss, and these losses."""
    parts = [_descended(world, index(code, some), images[some]) for some in _batches(len(images))]
    return joined([found for found, _ in parts]), torch.cat([losses for _, losses in parts])


class Descent:
    """Adam on entries of scene codes whose objects stand on the ground, by steps that become shorter."""

    free: dict[str, Tensor]
    """The entries that move, by name."""

    def __init__(self, code: SceneCode, first_steps: Mapping[str, float], slower: float) -> None:
        """Begin with copies of a code's entries.

        Args:
            code: Where to begin.
            first_steps: Length of the first step by entry, metres and units of the code.
            slower: Each step is so much shorter than the one before.
        """
        self.free = {name: code[name].clone().requires_grad_() for name in first_steps if name in code}
        groups = [{"params": [value], "lr": first_steps[name]} for name, value in self.free.items()]
        self._optimizer, self._slower = torch.optim.Adam(groups, betas=(0.7, 0.9)), slower

    def step(self, loss: Float[Tensor, ""]) -> None:
        """One step along the gradient of a loss."""
        self._optimizer.zero_grad()
        loss.backward()
        position = self.free[TRANSLATION].grad
        assert position is not None
        position[..., 1] = 0  # objects stand
        self._optimizer.step()
        for group in self._optimizer.param_groups:
            group["lr"] *= self._slower
        if COLOR in self.free:
            self.free[COLOR].data.clamp_(*COLOR_RANGE)


@torch.enable_grad()
def _descended(world: MeshWorld, code: dict[str, Tensor], images: Tensor) -> tuple[dict[str, Tensor], Tensor]:
    descent = Descent(code, _FIRST_STEPS, _SLOWER)
    best, lowest = code, torch.full((len(images),), math.inf)
    for _ in range(_NUM_STEPS):
        losses = _losses(world, {**code, **descent.free}, images)
        better = losses.detach() < lowest
        best = best | {name: _chosen(better, value.detach(), best[name]) for name, value in descent.free.items()}
        lowest = torch.minimum(lowest, losses.detach())
        descent.step(losses.sum())
    return best, lowest


def better_of(
    one: SceneCode, one_loss: Tensor, other: SceneCode, other_loss: Tensor
) -> tuple[dict[str, Tensor], Tensor]:
    """The code with the lower loss, and that loss, of each image."""
    better = one_loss < other_loss
    chosen = {name: _chosen(better, one[name], other[name]) for name in one}
    return chosen, torch.minimum(one_loss, other_loss)


def _chosen(better: Tensor, one: Tensor, other: Tensor) -> Tensor:
    return torch.where(better.view(-1, *[1] * (one.ndim - 1)), one, other)


def _losses(world: MeshWorld, code: SceneCode, images: Tensor) -> Float[Tensor, " batch"]:
    return (world.render(code) - images.float() / 255).square().sum((1, 2, 3))


def _batches(count: int) -> list[slice]:
    return [slice(first, first + _AT_ONCE) for first in range(0, count, _AT_ONCE)]
