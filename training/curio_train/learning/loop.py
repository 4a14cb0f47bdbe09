"""The training step and the loop around it, for every method and world.

A method is a set of loss terms (``config.METHODS``). Every random draw is a function of the seed and the step, so a run
that is stopped and resumed goes on as if uninterrupted.
"""

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from enum import Enum

import torch
from torch import Tensor

from curio_train.config import Recipe, RunConfig
from curio_train.errors import TrainingError, UsageError
from curio_train.learning.curiosity import critic_loss, curiosity_loss, frozen, gradient_penalty
from curio_train.learning.losses import image_loss
from curio_train.learning.parallel import Ranks
from curio_train.learning.precision import autocast
from curio_train.learning.prefetch import Prefetcher
from curio_train.learning.recoloring import recolored
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.learning.runs.interruption import Interruption
from curio_train.learning.runs.progress import Reporter
from curio_train.learning.self_training import SelfTraining
from curio_train.learning.sleep import sleep_codes
from curio_train.learning.state import TrainState
from curio_train.networks.base import StageNetwork
from curio_train.scene_code import SceneCode
from curio_train.worlds.base import Batch, ImageSource, World

_SMOOTHING = 0.98  # of the image loss that convergence is judged by: a memory of about 50 steps
_NUM_PAIRS = 8
_NUM_WARM_UP = 32
_SYNTHETIC = 1  # marks draws of sleep, so that they are not those of the data

SyntheticBatch = tuple[dict[str, Tensor], Tensor]
"""Scene codes, and the disturbed images of them that are to be read."""


class Outcome(Enum):
    """Why training ended, in words for the user."""

    CONVERGED = "converged: the image loss is below --stop-below"
    SPENT = "the budget is spent"
    INTERRUPTED = "interrupted"


class Trainer:
    """One run on one process: a world, its images, the networks, and how they learn.

    Attributes:
        config: What to learn and how.
        world: What is seen.
        ranks: This process among those that train together.
        state: All that changes.
    """

    def __init__(self, config: RunConfig, world: World, sources: Sequence[ImageSource], ranks: Ranks) -> None:
        """Build the networks.

        Args:
            config: What to learn and how.
            world: What is seen.
            sources: Images for each of the world's looks.
            ranks: This process among those that train together.

        Raises:
            UsageError: The world, or its network, does not go with the method.
        """
        if len(world.stages) > 1 and config.terms != {"sleep"}:
            raise UsageError(
                f"--method {config.method} compares images or labels of whole scenes, which the looks of a gaze do not "
                "see: expected --method sleep (or, with linemod, --no-gaze)"
            )
        self.config = config
        self.world = world
        self.ranks = ranks
        self.state = TrainState(config, world, ranks.device)
        self._sources = sources
        self._num_micro = config.recipe.batch_size // config.recipe.micro_batch_size
        self._share = ranks.share(self._num_micro)
        self._prefetcher: Prefetcher[SyntheticBatch] | None = None
        self._self_training = SelfTraining(
            self.state.pose.network, world, config.recipe.self_training, ranks.device, trained=config.init is not None
        )

    def step(self, rate: float) -> dict[str, float]:
        """One whole step: every micro-batch adds its gradients, then all networks move.

        Args:
            rate: Factor on the learning rates.

        Returns:
            Each loss term unweighted, and the critic's own loss as "critic"; means over the batch.

        Raises:
            TrainingError: A loss or a gradient is not finite. The networks are then left as they were.
        """
        recipe, terms, critic = self.config.recipe, self.config.terms, self.state.critic
        weights = {
            "image": recipe.image_weight,
            "curiosity": recipe.critic_weight,
            "sleep": recipe.sleep_weight,
            "label": 1.0,
        }
        turn = self._turn(self.state.course.step)
        world, source = self.world.stages[turn], self._sources[turn]
        network = self.state.stages[turn]
        sums: Counter[str] = Counter()
        for learner in self.state.learners.values():
            learner.optimizer.zero_grad()

        for micro in self._share:
            number = self.state.course.step * self._num_micro + micro
            losses: dict[str, Tensor] = {}

            # Awake: read the images, render what was read, compare one by one (image) and as a set (curiosity).
            if terms != {"sleep"}:
                batch = self._to_device(source.batch(number, recipe.micro_batch_size))
                if recipe.swap_colors and world.colors_interchangeable:
                    batch = recolored(batch, (self.config.seed, number))
                raw, code = self._read(network, batch.images)
                backgrounds = batch.backgrounds
            if terms & {"image", "curiosity"}:
                rendered = world.compared(world.render(code, backgrounds))
                images = world.compared(batch.images)
            if "image" in terms:
                losses["image"] = image_loss(rendered, images)
            if critic is not None:
                with frozen(critic.network):
                    losses["curiosity"] = curiosity_loss(self._judge, rendered)
            if "label" in terms and batch.code is not None:
                losses["label"] = world.code_loss(code, batch.code)

            # Asleep: render codes of one's own making, read them back.
            if "sleep" in terms:
                if terms == {"sleep"}:
                    dream, dreamt = self._prefetcher.take(number) if self._prefetcher else self._synthetic_batch(number)
                else:
                    dream, dreamt = self._perturbed_batch(raw, backgrounds, number)
                losses["sleep"] = world.code_loss(self._read(network, dreamt)[1], dream)

            torch.stack([weights[name] * loss for name, loss in losses.items()]).sum().div(self._num_micro).backward()

            # The critic: tell data from renderings, with the weights it had when it judged above.
            if critic is not None:
                losses["critic"] = critic_loss(self._judge, images, rendered)
                critic_total = losses["critic"]
                if recipe.gradient_penalty and self.state.course.step % recipe.gradient_penalty_every == 0:
                    weight = recipe.gradient_penalty * recipe.gradient_penalty_every
                    critic_total = critic_total + weight * gradient_penalty(self._judge, images)
                (critic_total / self._num_micro).backward()

            of_stage = f", {world.name}" if len(self.world.stages) > 1 else ""
            sums.update({name + of_stage: loss.item() / self._num_micro for name, loss in losses.items()})

        means = self._add_up_over_ranks(sums)
        self._move(means, rate)
        return means

    def _turn(self, step: int) -> int:
        """Which look a step teaches."""
        turns = self.world.turns
        return turns[step % len(turns)]

    @torch.no_grad()
    def _synthetic_batch(self, number: int) -> SyntheticBatch:
        """Of codes drawn by the world: a function of seed and number alone."""
        turn, size = self._turn(number // self._num_micro), self.config.recipe.micro_batch_size
        world, seed = self.world.stages[turn], (self.config.seed, number)
        backgrounds = self._sources[turn].backgrounds(number, size)
        code = self._to_device_code(world.sample(size, (*seed, _SYNTHETIC)))
        images = world.render(code, None if backgrounds is None else backgrounds.to(self.ranks.device))
        images = world.augment(images, seed)
        is_last = turn == len(self.world.stages) - 1
        return self._self_training.among(code, images, (*seed, _SYNTHETIC)) if is_last else (code, images)

    def study(self, progress: float) -> None:
        """Read photographs for self-training, if it is time to after this share of the budget; raises DataError."""
        if self._self_training.is_due(progress):
            self.wait_idle()
            self._self_training.study(progress)

    def _perturbed_batch(self, raw: SceneCode, backgrounds: Tensor | None, number: int) -> SyntheticBatch:
        """Of codes around those that were read of data."""
        recipe, seed = self.config.recipe, (self.config.seed, number)
        code = sleep_codes(self.world, raw, recipe.sleep_noise, recipe.sleep_drawn, seed)
        with torch.no_grad():
            return code, self.world.augment(self.world.render(code, backgrounds), seed)

    @contextmanager
    def prefetching(self) -> Iterator[None]:
        """Within it a method that only sleeps has the next images drawn in a thread, while the networks learn."""
        if self.config.terms != {"sleep"}:
            yield
            return
        with Prefetcher(self._synthetic_batch, self.ranks.size) as self._prefetcher:
            try:
                yield
            finally:
                self._prefetcher = None

    def wait_idle(self) -> None:
        """Wait for what is drawn ahead: of the renderer, one thread at a time makes use."""
        if self._prefetcher is not None:
            self._prefetcher.wait_idle()

    @torch.no_grad()
    def warm_up(self) -> None:
        """Do what takes most of a step's time, without a trace, so that it can be timed."""
        self.state.pose.network.eval()
        for look, network in zip(self.world.stages, self.state.stages, strict=True):
            size = (_NUM_WARM_UP, 3, look.camera.height, look.camera.width)
            self._read(network, torch.zeros(size, device=self.ranks.device))
        self.state.pose.network.train()

    @torch.no_grad()
    def pairs(self) -> tuple[Tensor, Tensor]:
        """A few training images, always the same, and what the (last) look, as it will be exported, makes of them."""
        look, network = self.world.stages[-1], self.state.stages[-1]
        batch = self._to_device(self._sources[-1].batch(0, _NUM_PAIRS))
        network.eval()
        rendered = look.render({**batch.given, **network(batch.images)}, batch.backgrounds)
        network.train()
        return batch.images, rendered

    def _read(self, network: StageNetwork, images: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """The network's raw outputs and scene codes; positions need float32, convolutions do not."""
        with self._autocast():
            # Channels last: convolutions of small images are a sixth quicker so on CPUs.
            latent = network.encoder(images.contiguous(memory_format=torch.channels_last))
        return network.decode(latent.float())

    def _judge(self, images: Tensor) -> Tensor:
        """The critic's logits."""
        assert self.state.critic is not None  # only methods with curiosity come here
        with self._autocast():
            logits: Tensor = self.state.critic.network(images)
        return logits.float()

    def _autocast(self) -> torch.autocast:
        return autocast(self.config.recipe.precision, self.ranks.device.type)

    def _to_device(self, batch: Batch) -> Batch:
        device = self.ranks.device
        return replace(
            batch,
            images=batch.images.to(device),
            backgrounds=None if batch.backgrounds is None else batch.backgrounds.to(device),
            code=None if batch.code is None else self._to_device_code(batch.code),
        )

    def _to_device_code(self, code: SceneCode) -> dict[str, Tensor]:
        return {name: value.to(self.ranks.device) for name, value in code.items()}

    def _add_up_over_ranks(self, sums: Counter[str]) -> dict[str, float]:
        """Sum gradients and losses over all processes, average batch norm's running statistics."""
        gradients = [
            parameter.grad
            for learner in self.state.learners.values()
            for parameter in learner.network.parameters()
            if parameter.grad is not None
        ]
        statistics = [value for value in self.state.pose.network.buffers() if value.is_floating_point()]
        losses = torch.tensor(list(sums.values()), device=self.ranks.device)
        for value in statistics:
            value /= self.ranks.size
        self.ranks.sum([*gradients, *statistics, losses])
        return dict(zip(sums, losses.tolist(), strict=True))

    def _move(self, losses: dict[str, float], rate: float) -> None:
        course, recipe = self.state.course, self.config.recipe
        bad = [name for name, value in losses.items() if not math.isfinite(value)]
        for who, learner in self.state.learners.items():
            if not learner.clip_gradient(recipe.gradient_clip):
                bad.append(f"the gradient of {who}")
        if bad:
            raise TrainingError(
                f"step {course.step + 1}: not finite: {', '.join(bad)}; the step is discarded. "
                "Go back to the last checkpoint, or start anew with a lower --learning-rate, or --precision float32"
            )
        for learner in self.state.learners.values():
            learner.step(rate)
        course.step += 1
        course.images += recipe.batch_size
        if "image" in losses:
            before = losses["image"] if course.image_loss is None else course.image_loss
            course.image_loss = _SMOOTHING * before + (1 - _SMOOTHING) * losses["image"]


def train(
    trainer: Trainer,
    run: RunFolder,
    interruption: Interruption,
    reporter: Reporter | None,
    checkpoint_minutes: float,
    finish: Callable[[], None],
) -> Outcome:
    """Train until convergence, the end of the budget, or a signal; leaves a checkpoint in each case.

    Only the process with a reporter writes: under torchrun all have the same state. ``finish`` is called before the
    last checkpoint of a run that was not interrupted.

    Raises:
        TrainingError: The optimisation broke down; the last checkpoint is the one to go back to.
        CheckpointError: A checkpoint could not be written; earlier ones are intact.
    """
    config, course, ranks = trainer.config, trainer.state.course, trainer.ranks
    saved_at, clock = course.seconds, time.monotonic()
    with interruption.deferred(), trainer.prefetching():
        while True:
            # All processes go by the slowest clock and by anyone's signal, so that they stop at the same step.
            seconds, signalled = ranks.largest(course.seconds, interruption.signum or 0)
            progress = config.progress(course.images, seconds)
            outcome = _outcome(config, course.image_loss, progress, bool(signalled))
            if outcome or seconds - saved_at >= 60 * checkpoint_minutes:
                trainer.wait_idle()
                if outcome and outcome is not Outcome.INTERRUPTED:
                    finish()
                if reporter:
                    run.save(trainer.state)
                    reporter.pictures(trainer.pairs())
                saved_at = seconds
            if outcome:
                return outcome
            trainer.study(progress)
            losses = trainer.step(learning_rate_factor(config.recipe, course.step, progress))
            course.seconds, clock = course.seconds + time.monotonic() - clock, time.monotonic()
            if reporter:
                reporter.step(losses, config.progress(course.images, course.seconds))


def _outcome(config: RunConfig, loss: float | None, progress: float, signalled: bool) -> Outcome | None:
    if loss is not None and loss < config.stop_below:
        return Outcome.CONVERGED
    if progress >= 1:
        return Outcome.SPENT
    return Outcome.INTERRUPTED if signalled else None


def learning_rate_factor(recipe: Recipe, step: int, progress: float) -> float:
    """Linear warm-up over the first steps, then a cosine from 1 down to ``final_learning_rate`` at the budget's end."""
    warm = min(1.0, (step + 1) / (recipe.warm_up_steps + 1))
    cosine = (1 + math.cos(math.pi * min(progress, 1.0))) / 2
    return warm * (recipe.final_learning_rate + (1 - recipe.final_learning_rate) * cosine)
