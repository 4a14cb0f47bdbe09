"""Every number a training run may be asked to change, as plain data without torch.

The command line, ``config.json`` of a run folder and the loop read these same classes.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

from tyro.conf import OmitArgPrefixes, Suppress

from curio_train.errors import UsageError

Term = Literal["image", "curiosity", "sleep", "label"]
Method = Literal["our", "noncur", "super", "sleep", "wake_sleep", "wake_sleep_critic", "templates"]
Preset = Literal["laptop", "paper"]
DecoderKind = Literal["whole", "cells"]

METHODS: Mapping[Method, frozenset[Term]] = {
    "our": frozenset({"image", "curiosity"}),
    "noncur": frozenset({"image"}),
    "super": frozenset({"label"}),
    "sleep": frozenset({"sleep"}),
    "wake_sleep": frozenset({"image", "sleep"}),
    "wake_sleep_critic": frozenset({"image", "curiosity", "sleep"}),
    "templates": frozenset(),
}
"""The loss terms of each method; the paper's own are the first three."""


@dataclass(frozen=True)
class ConvStack:
    """Widths and geometry of a stack of strided convolutions, first layer first."""

    widths: tuple[int, ...]
    kernels: tuple[int, ...]
    strides: tuple[int, ...]
    paddings: tuple[int, ...]

    def __post_init__(self) -> None:
        """Refuse lists of different lengths."""
        if len({len(self.widths), len(self.kernels), len(self.strides), len(self.paddings)}) != 1:
            raise UsageError(f"widths, kernels, strides and paddings must be equally long, found {self}")

    def output_side(self, side: int) -> int:
        """Pixels a side that are left of an image of ``side`` pixels."""
        for kernel, stride, padding in zip(self.kernels, self.strides, self.paddings, strict=True):
            side = (side + 2 * padding - kernel) // stride + 1
        return side


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the networks; the defaults are the paper's appendix as its parameter counts decide it.

    Attributes:
        encoder: 2,029,056 parameters, 128 → 30 → 14 → 7 → 4 → 1 pixels.
        critic: 1,883,713 parameters, 128 → 30 → 7 → 4 → 2 → 1 pixels.
        critic_normalisation: Both worked for the paper; its results use "batch".
        reading: How images of generated worlds and of parts on a plane are read. whole: the paper's way, all of a scene
            from one latent code. cells: every cell of the image says what is there, and slots are filled afterwards.
            Unless given, parts on a plane are read by cells (but not with preset paper, nor by wake–sleep, which needs
            the former), all else as a whole.
        row: Values each object slot gets from the shared trunk.
        hidden: Width of each branch's hidden layer.
    """

    encoder: Suppress[ConvStack] = ConvStack(
        (64, 192, 384, 256, 64), (11, 5, 3, 3, 3), (4, 2, 2, 2, 2), (0, 1, 1, 1, 0)
    )
    critic: Suppress[ConvStack] = ConvStack((64, 192, 384, 256, 1), (11, 5, 3, 3, 3), (4, 4, 2, 2, 2), (0, 0, 1, 1, 1))
    critic_normalisation: Literal["batch", "instance"] = "batch"
    reading: DecoderKind | None = None
    row: int = 32
    hidden: int = 64


@dataclass(frozen=True)
class WorldOptions:
    """What a user may choose about a world; each world has its own subclass in ``worlds/options.py``.

    Attributes:
        default_method: What --method is unless given.
        default_recipe: Where the preset laptop differs for this world, because that was measured to be better.
    """

    default_method: ClassVar[Method] = "our"
    default_recipe: ClassVar[Mapping[str, Any]] = {}


@dataclass(frozen=True)
class Recipe:
    """Hyperparameters of learning; the defaults are the paper's.

    Attributes:
        batch_size: Images a step.
        micro_batch_size: Images held in memory at once; gradients add up to those of a whole batch, batch norm sees one
            micro-batch at a time.
        learning_rate: Adam's, of encoder and heads.
        matrix_learning_rate: Muon's, of the matrices and convolutions of encoder and heads, whose other parameters
            stay with Adam; 0: all do.
        critic_learning_rate: Adam's, of the critic.
        warm_up_steps: Steps over which learning rates rise linearly from 0.
        final_learning_rate: Share of the learning rates that is left at the end of the budget, approached along a
            cosine; 1 keeps them constant.
        image_weight: Of the squared image error, summed over pixels and channels.
        critic_weight: Of the curiosity term.
        gradient_penalty: R1: weight of the critic's squared gradient at data images; 0 is off.
        gradient_penalty_every: Steps between penalties, each weighted up by as many.
        sleep_weight: Of the distance between sleep codes and what the network reads from their renderings.
        sleep_noise: Standard deviation of sleep codes around the network's own predictions, in half ranges.
        swap_colors: Show each image with its colour channels in a random order, and its true colours likewise, in
            worlds of which that makes nothing else.
        sleep_drawn: Share of sleep codes drawn from the world's known range instead of around own predictions; all are
            with --method sleep, which makes no predictions of the data.
        self_training: Share of the second look's images that are photographs, with the poses that the network has read
            in them and render-and-compare has refined, in the last two fifths of a run that sleeps, or in the last four
            where it began as another (--init); 0: none. Only where a world has photographs.
        gradient_clip: Largest L2 norm of a step's gradient, of the network and of the critic each.
        precision: Of the convolutions, bfloat16 only where the machine is quick with it; all else is in float32.
        budget_images: Images to show where neither --minutes nor --images is given.
    """

    batch_size: int = 128
    micro_batch_size: int = 32
    learning_rate: float = 1e-4
    matrix_learning_rate: float = 0.0
    critic_learning_rate: float = 1e-6
    warm_up_steps: int = 0
    final_learning_rate: float = 1.0
    image_weight: float = 0.01
    critic_weight: float = 10.0
    gradient_penalty: float = 0.0
    gradient_penalty_every: int = 1
    sleep_weight: float = 1.0
    sleep_noise: float = 0.5
    swap_colors: bool = False
    sleep_drawn: float = 0.5
    self_training: float = 0.0
    gradient_clip: float = 0.5
    precision: Literal["float32", "bfloat16"] = "float32"
    budget_images: int = 6_400_000

    def __post_init__(self) -> None:
        """Refuse what no run could use."""
        for name in (
            "batch_size",
            "micro_batch_size",
            "learning_rate",
            "gradient_clip",
            "gradient_penalty_every",
            "budget_images",
        ):
            if getattr(self, name) <= 0:
                raise UsageError(f"{_flag(name)} is {getattr(self, name)}, expected more than 0")
        if not 0 <= self.self_training < 1:
            raise UsageError(f"--self-training {self.self_training}: expected 0 or more, and less than 1")
        if self.batch_size % self.micro_batch_size or self.micro_batch_size < 2:
            raise UsageError(
                f"--batch-size {self.batch_size} cannot be cut into micro-batches of {self.micro_batch_size}; "
                "expected --micro-batch-size to divide it and be at least 2, because batch norm needs two images"
            )


PRESETS: Mapping[Preset, Recipe] = {
    "paper": Recipe(),
    "laptop": Recipe(
        batch_size=64,
        micro_batch_size=64,
        learning_rate=2e-3,
        critic_learning_rate=1e-4,
        warm_up_steps=50,
        final_learning_rate=0.02,
        swap_colors=True,
        critic_weight=0.1,
        gradient_penalty=10.0,
        gradient_penalty_every=8,
        precision="bfloat16",
        budget_images=48_000,
    ),
}


def preset_recipe(preset: Preset, world: type[WorldOptions]) -> Recipe:
    """The hyperparameters that a preset means in a world."""
    return replace(PRESETS[preset], **world.default_recipe) if preset == "laptop" else PRESETS[preset]


@dataclass(frozen=True)
class RunConfig:
    """All that decides what a run learns; ``config.json`` of its folder.

    Attributes:
        world: The world's own options.
        method: our: image loss and critic. noncur: image loss alone. super: true scene codes. Beyond the paper,
            sleep: renderings of codes from the world's known range, to regress. wake_sleep: image loss, and sleep
            with half of the codes around own predictions. wake_sleep_critic: that and the critic. templates: no training
            at all; renderings of the object are compared with frames by pretrained features.
        labels: Share of the training images that --method super sees, with their true codes (paper: 0.05, 0.1, 1).
        preset: Hyperparameters to start from: laptop (measured on two cores) or paper (the paper's).
        seed: Of the initial weights and every random draw.
        minutes: Budget of training time, in minutes.
        images: Budget of images shown. Where both budgets are given the first to be reached ends the run.
        stop_below: Converged, and done, when the image loss (summed squared error an image, smoothed) is below this;
            0 never is.
        recipe: Hyperparameters; the preset's unless given.
        network: Sizes of the networks; the paper's unless given.
        init: Run folder, model folder (its latest version) or version's folder whose network to begin with instead of
            random weights; of this world's kind, but the object may be another: features that read one object read the
            next one sooner.
    """

    world: OmitArgPrefixes[WorldOptions]
    method: Method = "our"
    labels: float = 1.0
    preset: Preset = "laptop"
    seed: int = 0
    minutes: float | None = None
    images: int | None = None
    stop_below: float = 0.0
    recipe: OmitArgPrefixes[Recipe] = PRESETS["laptop"]
    network: OmitArgPrefixes[NetworkConfig] = NetworkConfig()
    init: Path | None = None

    def __post_init__(self) -> None:
        """Refuse what contradicts itself."""
        if not 0 < self.labels <= 1:
            raise UsageError(f"--labels {self.labels} is no share, expected more than 0 and at most 1")
        if self.labels != 1 and self.method != "super":
            raise UsageError(
                f"--labels {self.labels} with --method {self.method}, which uses none; expected --method super"
            )
        if self.stop_below and "image" not in self.terms:
            raise UsageError(f"--stop-below watches the image loss, which --method {self.method} does not have")
        for name in ("minutes", "images"):
            if getattr(self, name) is not None and not getattr(self, name) > 0:
                raise UsageError(f"{_flag(name)} is {getattr(self, name)}, expected more than 0")

    @property
    def terms(self) -> frozenset[Term]:
        """The method's loss terms."""
        return METHODS[self.method]

    def progress(self, images: int, seconds: float) -> float:
        """Share of the budget that is spent; 1 or more when it is used up."""
        if self.images is None and self.minutes is None:
            return images / self.recipe.budget_images
        by_images = images / self.images if self.images is not None else 0.0
        by_time = seconds / (60 * self.minutes) if self.minutes is not None else 0.0
        return max(by_images, by_time)


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")
