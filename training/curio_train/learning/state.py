"""All that changes while a run learns: what a checkpoint holds."""

from dataclasses import astuple, dataclass, replace
from functools import cached_property
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor, nn
from torch.optim import Adam, Optimizer

from curio_train.config import ConvStack, RunConfig
from curio_train.errors import UsageError
from curio_train.learning.muon import Muon
from curio_train.networks.base import StageNetwork
from curio_train.networks.paper.critic import Critic
from curio_train.templates.build import template_network
from curio_train.worlds.base import StagedWorld, World, stages_of

N = TypeVar("N", bound=nn.Module)
_BETAS = (0.9, 0.999)  # paper, appendix, table of hyperparameters


class Learner(Generic[N]):
    """A network with its optimiser."""

    network: N
    """The network that learns."""

    def __init__(self, network: N, learning_rate: float, matrix_learning_rate: float = 0.0) -> None:
        """Keep what the optimiser will need.

        Args:
            network: What is to learn.
            learning_rate: Adam's, before warm-up and decay.
            matrix_learning_rate: Muon's, for matrices and convolutions; 0: Adam moves them, too.
        """
        self.network = network
        self._learning_rate, self._matrix_learning_rate = learning_rate, matrix_learning_rate

    @cached_property
    def optimizer(self) -> Optimizer:
        """Adam, as in the paper, or Muon.

        It is made when something learns: torch's first optimiser imports its compiler, which takes 2 to 3 seconds that
        evaluation need not wait.
        """
        parameters = self.network.parameters()
        optimizer: Optimizer
        if self._matrix_learning_rate:
            optimizer = Muon(parameters, self._matrix_learning_rate, self._learning_rate)
        else:
            optimizer = Adam(parameters, self._learning_rate, betas=_BETAS)
        for group in optimizer.param_groups:
            group["initial_lr"] = group["lr"]
        return optimizer

    def clip_gradient(self, largest: float) -> bool:
        """Clip the accumulated gradient to this L2 norm; returns whether it was finite."""
        return bool(nn.utils.clip_grad_norm_(self.network.parameters(), largest).isfinite())

    def step(self, rate: float) -> None:
        """Step along the accumulated gradient with ``rate`` times the learning rates."""
        for group in self.optimizer.param_groups:
            group["lr"] = rate * group["initial_lr"]
        self.optimizer.step()

    def tensors(self) -> dict[str, Tensor]:
        """Weights, buffers and the optimiser's moments by name."""
        weights = {f"network.{name}": value for name, value in self.network.state_dict().items()}
        moments = {
            f"optimizer.{number}.{name}": value
            for number, entry in self.optimizer.state_dict()["state"].items()
            for name, value in entry.items()
        }
        return weights | moments

    def load(self, tensors: dict[str, Tensor]) -> None:
        """Take over what :meth:`tensors` gave.

        Raises:
            RuntimeError: Names or shapes differ from this network's.
        """
        self.network.load_state_dict(under("network.", tensors))
        entries: dict[int, dict[str, Tensor]] = {}
        for key, value in under("optimizer.", tensors).items():
            number, name = key.split(".")
            entries.setdefault(int(number), {})[name] = value
        self.optimizer.load_state_dict({**self.optimizer.state_dict(), "state": entries})


@dataclass
class TrainingProgress:
    """The progress of a run; ``course.json`` of a checkpoint."""

    step: int = 0
    """Steps done. Every random draw is a function of the seed and this number: there is no other random state."""
    images: int = 0
    """Images shown."""
    seconds: float = 0.0
    """Time spent training, over all sessions."""
    image_loss: float | None = None
    """Unweighted and smoothed; None before the first step and for methods without it."""
    images_before: int = 0
    """Images shown before this run, where it began with trained weights (``--init``)."""
    seconds_before: float = 0.0
    """Time spent before this run's first step: on training the weights that it began with, and on searching for the
    scenes of its training images (``--method hypotheses``)."""
    finished_step: int | None = None
    """Step after which the network was finished: its templates learned of photographs, its confidence was calibrated.
    None: it was not yet."""

    def __post_init__(self) -> None:
        """Refuse numbers that no run can reach.

        Raises:
            ValueError: One is negative, not finite or larger than 2⁵³.
        """
        if not all(value is None or 0 <= value <= 1 << 53 for value in astuple(self)):
            raise ValueError(f"found {self}, expected numbers from 0 to 2⁵³")

    @property
    def all_images(self) -> int:
        """Images shown to the network since it had random weights."""
        return self.images_before + self.images

    @property
    def all_seconds(self) -> float:
        """Time spent on the network since it had random weights."""
        return self.seconds_before + self.seconds


class TrainState:
    """The networks, their optimisers, and the progress of the run."""

    progress: TrainingProgress
    """How far the run is."""
    stages: list[StageNetwork]
    """The network of each of the world's stages."""
    pose: Learner[nn.Module]
    """All stages as one network."""
    critic: Learner[Critic] | None
    """The critic; None without the loss term curiosity."""

    def __init__(self, config: RunConfig, world: World, device: torch.device) -> None:
        """Everything before the first step.

        Raises:
            UsageError: The world has no such decoder.
        """
        decoder = config.network.reading
        if decoder is not None and decoder not in world.decoders:
            raise UsageError(f"--reading {decoder}: {world.name} has no such decoder; leave the flag out")
        torch.manual_seed(config.seed)
        self.progress = TrainingProgress()
        templates = config.terms.templates
        self.stages = [] if templates else [stage.network(config.network) for stage in stages_of(world)]
        recipe = config.recipe
        if templates:
            network: nn.Module = template_network(world)
        else:
            network = world.assemble(self.stages) if isinstance(world, StagedWorld) else self.stages[0]
        self.pose = Learner(network.to(device), recipe.learning_rate, recipe.matrix_learning_rate)
        self.critic = None
        if config.terms.curiosity:
            critic = Critic(_critic_stack(config, world), config.network.critic_normalisation).to(device)
            self.critic = Learner(critic, config.recipe.critic_learning_rate)

    @property
    def learners(self) -> dict[str, Learner[Any]]:
        """All that learn, by name."""
        return {"pose": self.pose} | ({"critic": self.critic} if self.critic else {})

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name, see :meth:`Learner.tensors`."""
        return {f"{who}.{name}": value for who, one in self.learners.items() for name, value in one.tensors().items()}

    def load(self, tensors: dict[str, Tensor], progress: TrainingProgress) -> None:
        """Go back to where :meth:`tensors` and ``progress`` were taken.

        Raises:
            RuntimeError: The tensors are not those of these networks.
        """
        for who, learner in self.learners.items():
            learner.load(under(f"{who}.", tensors))
        self.progress = progress

    def load_trained(self, tensors: dict[str, Tensor], progress: TrainingProgress) -> None:
        """Take over weights and progress alone: nothing is trained any more.

        Raises:
            RuntimeError: The tensors are not those of this network.
        """
        self.pose.network.load_state_dict(under("pose.network.", tensors))
        self.progress = progress


def _critic_stack(config: RunConfig, world: World) -> ConvStack:
    """The critic's layers; of crops, which have half the paper's side, the second has half the stride.

    With the paper's strides only one pixel would reach its last two layers.
    """
    stack = config.network.critic
    if len(stages_of(world)) == 1:
        return stack
    first, second, *others = stack.strides
    return replace(stack, strides=(first, second // 2, *others))


def under(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The tensors whose names begin with ``prefix``; the returned names are without it."""
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
