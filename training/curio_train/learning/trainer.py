"""One training step, for every method and world.

``config.METHODS`` names the loss terms of each method. Every random draw is a function of the seed and the step, so a
run that is stopped and resumed goes on as if uninterrupted.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from curio_train.config import RunConfig
from curio_train.errors import TrainingError, UsageError
from curio_train.learning.hardware import autocast
from curio_train.learning.losses import critic_loss, curiosity_loss, frozen, gradient_penalty, image_loss
from curio_train.learning.parallel import Ranks
from curio_train.learning.recoloring import recolored
from curio_train.learning.self_training import SelfTraining
from curio_train.learning.sleep import SyntheticBatches, trained_stage
from curio_train.learning.state import TrainState
from curio_train.metrics.images import blurred
from curio_train.networks.base import StageNetwork
from curio_train.refinement.own_crops import OwnCrops
from curio_train.worlds.base import Batch, ImageSource, StagedWorld, World, stages_of
from curio_train.worlds.single_object.two_stage import TwoStageWorld

_SMOOTHING = 0.98  # of the image loss that convergence is judged by: a memory of about 50 steps
_NUM_PAIRS = 8
_NUM_WARM_UP = 32


def check_rendered_stages(config: RunConfig, world: World) -> None:
    """Refuse detectors in stages whose answers are no poses yet, because an image loss could not teach them.

    Raises:
        UsageError: Its poses are those of templates, or its first stage is not trained.
    """
    if not (isinstance(world, StagedWorld) and config.terms.renders_predictions):
        return
    if not isinstance(world, TwoStageWorld):
        raise UsageError(
            f"--method {config.method} teaches how poses are read, and a detector for several objects reads them by "
            "templates: use --method sleep, or train one object"
        )
    if config.init is None:
        raise UsageError(
            f"--method {config.method} teaches the second stage on crops around the first one's answers, which must be "
            "trained: add --init RUN, of --method hypotheses or sleep (or, with linemod, --one-stage)"
        )


@dataclass(frozen=True, eq=False)
class Stage:
    """One stage of the network and what it learns from; most worlds have one, two-stage detectors two."""

    world: World
    network: StageNetwork
    source: ImageSource


class Trainer:
    """The networks of one run and how they learn, on one process."""

    config: RunConfig
    """What to learn and how."""
    world: World
    """Draws and renders scenes."""
    ranks: Ranks
    """This process among those that train together."""
    state: TrainState
    """All that changes."""
    synthetic: SyntheticBatches
    """Renderings of known scene codes, for the loss term ``sleep``."""

    def __init__(self, config: RunConfig, world: World, sources: Sequence[ImageSource], ranks: Ranks) -> None:
        """Build the networks.

        Args:
            config: What to learn and how.
            world: Draws and renders scenes.
            sources: Images for each of the world's stages; where predictions are rendered, whole frames for the first.
            ranks: This process among those that train together.

        Raises:
            UsageError: The method cannot train this world, or its network.
        """
        check_rendered_stages(config, world)
        self.config, self.world, self.ranks = config, world, ranks
        self.state = TrainState(config, world, ranks.device)
        self._optimizers = [learner.optimizer for learner in self.state.learners.values()]  # before time is taken
        self._num_micro = config.recipe.batch_size // config.recipe.micro_batch_size
        self._micro_batches = ranks.micro_batches(self._num_micro)
        seen = sources
        if isinstance(world, TwoStageWorld) and config.terms.renders_predictions:
            crops = OwnCrops(world, self.state.stages[0], sources[0], config.seed, config.recipe.self_training)
            seen = [sources[0], crops]
        self._stages = [Stage(*parts) for parts in zip(stages_of(world), self.state.stages, seen, strict=True)]
        network, fraction = self.state.pose.network, config.recipe.self_training if config.terms.sleep else 0.0
        self.self_training = SelfTraining(
            network, world, fraction, ranks.device, pretrained=config.init is not None, minutes=config.minutes
        )
        self.synthetic = SyntheticBatches(config, world, sources, ranks, self.self_training)

    def step(self, rate: float) -> dict[str, float]:
        """One whole step: every micro-batch adds its gradients, then all networks move.

        Args:
            rate: Factor on the learning rates.

        Returns:
            Each loss term unweighted, and the critic's own loss as "critic"; means over the batch.

        Raises:
            TrainingError: A loss or a gradient is not finite. The networks are then left as they were.
        """
        terms, critic = self.config.terms, self.state.critic
        stage = self._stages[trained_stage(self.config, self.world, self.state.progress.step)]
        world, network = stage.world, stage.network
        sums: Counter[str] = Counter()
        for optimizer in self._optimizers:
            optimizer.zero_grad()

        for micro in self._micro_batches:
            number = self.state.progress.step * self._num_micro + micro
            losses: dict[str, Tensor] = {}

            # Wake: predict codes of training images; compare with the true codes, or re-render and compare the images.
            if terms.reads_images:
                batch = self._training_batch(stage, number)
                raw, code = self._predict(network, batch.images)
            if terms.renders_predictions:
                shown = world.comparable({**batch.given, **code}, batch.images)
                rendered = blurred(world.render(shown, batch.backgrounds), world.comparison_blur_px)
                images = blurred(batch.images, world.comparison_blur_px)
            if terms.image:
                losses["image"] = image_loss(rendered, images)
            if critic is not None:
                with frozen(critic.network):
                    losses["curiosity"] = curiosity_loss(self._judge, rendered)
            if terms.label and batch.code is not None:
                losses["label"] = world.code_loss(code, batch.code)
            if terms.hypotheses and batch.code is not None:
                losses["hypotheses"] = world.code_loss(code, batch.code)

            # Sleep: render known codes, predict them.
            if terms.perturbs_predictions and network.has_raw_values:
                true, synthetic = self.synthetic.around(raw, batch.backgrounds, number)
            elif terms.sleep:
                true, synthetic = self.synthetic.take(number)
            if terms.sleep:
                losses["sleep"] = world.code_loss(self._predict(network, synthetic)[1], true)

            (self._weighted_sum(losses) / self._num_micro).backward()

            # The critic learns to tell data from renderings, starting from the weights it judged with above.
            if critic is not None:
                losses["critic"] = self._critic_backward(images, rendered)
            sums.update({self._loss_name(name, stage): loss.item() / self._num_micro for name, loss in losses.items()})

        means = self._sum_over_ranks(sums)
        self._move(means, rate)
        return means

    def _weighted_sum(self, losses: dict[str, Tensor]) -> Tensor:
        """The objective of encoder and heads."""
        recipe = self.config.recipe
        weights = {"image": recipe.image_weight, "curiosity": recipe.critic_weight, "sleep": recipe.sleep_weight}
        return torch.stack([weights.get(name, 1.0) * loss for name, loss in losses.items()]).sum()

    def _critic_backward(self, images: Tensor, rendered: Tensor) -> Tensor:
        """Add the gradients of the critic's own objective; returns its loss without the gradient penalty."""
        recipe = self.config.recipe
        loss = total = critic_loss(self._judge, images, rendered)
        if recipe.gradient_penalty and self.state.progress.step % recipe.gradient_penalty_every == 0:
            weight = recipe.gradient_penalty * recipe.gradient_penalty_every
            total = loss + weight * gradient_penalty(self._judge, images)
        (total / self._num_micro).backward()
        return loss

    def _loss_name(self, name: str, stage: Stage) -> str:
        only_one = len(self._stages) == 1 or self.config.terms.renders_predictions
        return name if only_one else f"{name}, {stage.world.name}"

    @torch.no_grad()
    def warm_up(self) -> None:
        """Run what takes most of a step's time, without an effect on the training, so that it can be timed."""
        self.state.pose.network.eval()
        for stage in self._stages:
            size = (_NUM_WARM_UP, 3, stage.world.camera.height, stage.world.camera.width)
            self._predict(stage.network, torch.zeros(size, device=self.ranks.device))
        self.state.pose.network.train()

    @torch.no_grad()
    def pairs(self) -> tuple[Tensor, Tensor]:
        """The first training images and their re-renderings by the last stage, as exported; [num, 3, height, width]."""
        stage = self._stages[-1]
        batch = self._to_device(stage.source.batch(0, _NUM_PAIRS))
        stage.network.eval()
        rendered = stage.world.render({**batch.given, **stage.network(batch.images)}, batch.backgrounds)
        stage.network.train()
        return batch.images, rendered

    def _training_batch(self, stage: Stage, number: int) -> Batch:
        recipe = self.config.recipe
        batch = self._to_device(stage.source.batch(number, recipe.micro_batch_size))
        if recipe.swap_colors and stage.world.colors_interchangeable:
            batch = recolored(batch, (self.config.seed, number))
        return batch

    def _predict(self, network: StageNetwork, images: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
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
            code=None if batch.code is None else {name: value.to(device) for name, value in batch.code.items()},
            given={name: value.to(device) for name, value in batch.given.items()},
        )

    def _sum_over_ranks(self, sums: Counter[str]) -> dict[str, float]:
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
        """Step all optimisers and note the progress."""
        progress, recipe = self.state.progress, self.config.recipe
        bad = [name for name, value in losses.items() if not math.isfinite(value)]
        for who, learner in self.state.learners.items():
            if not learner.clip_gradient(recipe.gradient_clip):
                bad.append(f"the gradient of {who}")
        if bad:
            raise TrainingError(
                f"step {progress.step + 1}: not finite: {', '.join(bad)}; the step is discarded. "
                "Go back to the last checkpoint, or start anew with a lower --learning-rate, or --precision float32"
            )
        for learner in self.state.learners.values():
            learner.step(rate)
        progress.step += 1
        progress.images += recipe.batch_size
        if "image" in losses:
            before = losses["image"] if progress.image_loss is None else progress.image_loss
            progress.image_loss = _SMOOTHING * before + (1 - _SMOOTHING) * losses["image"]
