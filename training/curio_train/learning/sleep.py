"""Synthetic batches: renderings of known scene codes, the "sleep" phase of wake–sleep (Hinton et al. 1995).

The paper has no such term. The network learns to predict the codes of renderings. A run with ``--method sleep`` draws
all codes from the range that the world declares. Wake–sleep draws half of them around the network's own predictions for
training images, and all of them from the range where the network has no raw values to draw around. Neither uses labels
of the data.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor

from curio_train.config import RunConfig
from curio_train.learning.parallel import Ranks
from curio_train.learning.prefetch import Prefetcher, prefetching
from curio_train.learning.self_training import SelfTraining
from curio_train.metrics.assignment import canonical
from curio_train.scene_code import SceneCode
from curio_train.worlds.base import ImageSource, StagedWorld, World, stages_of

_SYNTHETIC = 1  # keeps these draws apart from those of the training images

SyntheticBatch = tuple[dict[str, Tensor], Tensor]
"""Scene codes, and augmented renderings of them [batch, 3, height, width]."""


def trained_stage(config: RunConfig, world: World, step: int) -> int:
    """Which of the world's stages a step trains."""
    if not isinstance(world, StagedWorld):
        return 0
    if config.terms.renders_predictions:
        # An image loss teaches the last stage alone, on crops around the answers of the one before.
        return len(world.stages) - 1
    return world.stage_schedule[step % len(world.stage_schedule)]


class SyntheticBatches:
    """Draws and renders the synthetic batches of one run, ahead of the training step where that is possible."""

    def __init__(
        self,
        config: RunConfig,
        world: World,
        sources: Sequence[ImageSource],
        ranks: Ranks,
        self_training: SelfTraining,
    ) -> None:
        """Prepare to draw.

        Args:
            config: Seed, batch size and noise.
            world: Draws and renders scenes.
            sources: Give the backgrounds of renderings, for each of the world's stages.
            ranks: This process among those that train together.
            self_training: Gives crops of photographs for the last stage.
        """
        self._config, self._world, self._sources, self._ranks = config, world, sources, ranks
        self._self_training = self_training
        self._num_micro = config.recipe.batch_size // config.recipe.micro_batch_size
        self._prefetcher: Prefetcher[SyntheticBatch] | None = None

    @contextmanager
    def prefetching(self) -> Iterator[None]:
        """Render the next batch in a thread while the networks learn, if the method uses no training images."""
        if self._config.terms.reads_images:
            yield
            return
        with prefetching(self._draw, self._ranks.size) as self._prefetcher:
            try:
                yield
            finally:
                self._prefetcher = None

    def wait_idle(self) -> None:
        """Wait for the prefetch thread; the renderer is not thread-safe."""
        if self._prefetcher is not None:
            self._prefetcher.wait_idle()

    def update_pseudo_labels(self, spent: float) -> None:
        """Make pseudo-labels of the photographs if a round is due after this fraction of the budget.

        Raises:
            DataError: A photograph cannot be read, or is not of the camera's size.
        """
        if self._self_training.is_due(spent):
            self.wait_idle()
            self._self_training.run_round(spent)

    def take(self, number: int) -> SyntheticBatch:
        """Micro-batch ``number`` with codes drawn from the world's range, a function of seed and number alone."""
        return self._prefetcher.take(number) if self._prefetcher else self._draw(number)

    def around(self, raw: SceneCode, backgrounds: Tensor | None, number: int) -> SyntheticBatch:
        """Micro-batch ``number`` with codes around predictions ``raw`` for training images over ``backgrounds``."""
        recipe, seed = self._config.recipe, (self._config.seed, number)
        code = sleep_codes(self._world, raw, recipe.sleep_noise, recipe.sleep_drawn, seed)
        with torch.no_grad():
            return code, self._world.augment(self._world.render(code, backgrounds), seed)

    @torch.no_grad()
    def _draw(self, number: int) -> SyntheticBatch:
        stage = trained_stage(self._config, self._world, number // self._num_micro)
        size = self._config.recipe.micro_batch_size
        world, device = stages_of(self._world)[stage], self._ranks.device
        seed = self._config.seed, number
        backgrounds = self._sources[stage].backgrounds(number, size)
        code = {name: value.to(device) for name, value in world.sample(size, (*seed, _SYNTHETIC)).items()}
        images = world.render(code, None if backgrounds is None else backgrounds.to(device))
        images = world.augment(images, seed)
        if stage == len(stages_of(self._world)) - 1:
            return self._self_training.mix_in(code, images, (*seed, _SYNTHETIC))
        return code, images


def sleep_codes(world: World, raw: SceneCode, noise: float, drawn: float, seed: tuple[int, ...]) -> dict[str, Tensor]:
    """Draw scene codes to render, as many as there are predictions.

    Args:
        world: Declares the range and draws from it.
        raw: The network's predictions before activation, in which 0 to ±1 is half the range and bounds are kept.
        noise: Standard deviation of the perturbation, in the units of ``raw``; each code gets a fraction of it drawn
            uniformly, so that small and large perturbations both occur.
        drawn: Fraction of the codes that are drawn from the world's range.
        seed: Decides every draw.

    Returns:
        Codes without gradient, rotations in their canonical form, because their length cannot be seen.
    """
    num = len(next(iter(raw.values())))
    num_drawn = round(drawn * num)
    random = np.random.default_rng(seed)
    deviations = random.random(num).astype(np.float32) * noise
    perturbed = {
        name: value.detach() + _like(deviations, value) * _like(random.standard_normal(value.shape, np.float32), value)
        for name, value in raw.items()
    }
    code = canonical(world.layout.activate(perturbed))
    if num_drawn:
        from_range = world.sample(num_drawn, seed)
        code = {name: torch.cat([from_range[name].to(value), value[num_drawn:]]) for name, value in code.items()}
    return code


def _like(values: np.ndarray, tensor: Tensor) -> Tensor:
    """Move values to the device of ``tensor`` and add trailing dimensions for broadcasting."""
    return torch.from_numpy(values).to(tensor).view(*values.shape, *(1,) * (tensor.dim() - values.ndim))
