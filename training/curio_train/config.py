"""Configuration of a training run as plain dataclasses, without torch.

The command line, ``config.json`` of a run folder and the training loop share these classes. The string under each field
is its help text.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

from tyro.conf import OmitArgPrefixes, Suppress

from curio_train.errors import UsageError

MethodName = Literal["our", "noncur", "super", "sleep", "wake_sleep", "wake_sleep_critic", "hypotheses", "templates"]
Preset = Literal["laptop", "paper"]
DecoderKind = Literal["whole", "cells"]


@dataclass(frozen=True)
class Method:
    """A training method: the loss terms that it adds up."""

    image: bool = False
    """Squared error between the training images and the re-renderings of what the network predicts for them."""
    curiosity: bool = False
    """The critic's verdict on these re-renderings."""
    sleep: bool = False
    """Error of what the network predicts for renderings of known scene codes."""
    label: bool = False
    """Error of what the network predicts for training images whose scene codes are given."""
    hypotheses: bool = False
    """Error against the scene whose rendering, among many hypotheses, has the lowest image loss."""
    templates: bool = False
    """Nothing is trained: renderings of the object are stored and compared with frames by pretrained features."""

    @property
    def reads_images(self) -> bool:
        """Whether the network is run on training images at all; else it learns from renderings alone."""
        return self.image or self.curiosity or self.label or self.hypotheses

    @property
    def knows_codes(self) -> bool:
        """Whether true scene codes are used at all, of training images or of renderings."""
        return self.sleep or self.label

    @property
    def renders_predictions(self) -> bool:
        """Whether predictions for training images are rendered and compared with them."""
        return self.image or self.curiosity

    @property
    def perturbs_predictions(self) -> bool:
        """Whether ``sleep`` draws scene codes around predictions, where the network has raw values."""
        return self.sleep and self.reads_images


METHODS: Mapping[MethodName, Method] = {
    "our": Method(image=True, curiosity=True),
    "noncur": Method(image=True),
    "super": Method(label=True),
    "sleep": Method(sleep=True),
    "wake_sleep": Method(image=True, sleep=True),
    "wake_sleep_critic": Method(image=True, curiosity=True, sleep=True),
    "hypotheses": Method(hypotheses=True),
    "templates": Method(templates=True),
}
"""All methods by name; the first three are the paper's."""


@dataclass(frozen=True)
class ConvStack:
    """Channels and geometry of a stack of strided convolutions, first layer first."""

    widths: tuple[int, ...]
    kernels: tuple[int, ...]
    strides: tuple[int, ...]
    paddings: tuple[int, ...]

    def __post_init__(self) -> None:
        """Refuse lists of different lengths."""
        if len({len(self.widths), len(self.kernels), len(self.strides), len(self.paddings)}) != 1:
            raise UsageError(f"widths, kernels, strides and paddings must be equally long, found {self}")

    def output_side(self, side: int) -> int:
        """Side of the output, in pixels, for an input of ``side`` x ``side`` pixels."""
        for kernel, stride, padding in zip(self.kernels, self.strides, self.paddings, strict=True):
            side = (side + 2 * padding - kernel) // stride + 1
        return side


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the networks; the defaults are the paper's appendix as its parameter counts decide it."""

    encoder: Suppress[ConvStack] = ConvStack(
        (64, 192, 384, 256, 64), (11, 5, 3, 3, 3), (4, 2, 2, 2, 2), (0, 1, 1, 1, 0)
    )
    """2,029,056 parameters, 128 → 30 → 14 → 7 → 4 → 1 pixels."""
    critic: Suppress[ConvStack] = ConvStack((64, 192, 384, 256, 1), (11, 5, 3, 3, 3), (4, 4, 2, 2, 2), (0, 0, 1, 1, 1))
    """1,883,713 parameters, 128 → 30 → 7 → 4 → 2 → 1 pixels."""
    critic_normalisation: Literal["batch", "instance"] = "batch"
    """Both worked for the paper; its results use "batch"."""
    reading: DecoderKind | None = None
    """Decoder for images of generated worlds and of parts on a plane. whole: the paper's global decoder, which predicts
    all slots of a scene from one latent code. cells: a dense decoder, which predicts an object at every grid cell and
    fills the slots from the surest cells. Unless given, parts on a plane use cells (but not with preset paper, nor with
    wake–sleep, which draws codes around whole's raw values), all else uses whole."""
    row: int = 32
    """Values each object slot gets from the shared trunk."""
    hidden: int = 64
    """Width of each branch's hidden layer."""

    def __post_init__(self) -> None:
        """Refuse layers without a value."""
        for name in ("row", "hidden"):
            if getattr(self, name) < 1:
                raise UsageError(f"{_flag(name)} is {getattr(self, name)}, expected at least 1")


@dataclass(frozen=True)
class WorldOptions:
    """The options of a world; each world has its own subclass in ``worlds/options.py``."""

    default_method: ClassVar[MethodName] = "our"
    """The method unless --method is given."""
    default_recipe: ClassVar[Mapping[str, Any]] = {}
    """Hyperparameters that were measured to be better for this world than those of the preset laptop."""
    is_flat: ClassVar[bool] = False
    """Whether its scenes have two dimensions and no camera matrix, so that ``curio-view`` cannot show them."""

    @classmethod
    def upgraded(cls, stored: Mapping[str, Any]) -> Mapping[str, Any]:
        """Options of a stored configuration with what it means by leaving out options that are newer than it is."""
        return stored


@dataclass(frozen=True)
class Recipe:
    """Hyperparameters of learning; the defaults are the paper's."""

    batch_size: int = 128
    """Images a step."""
    micro_batch_size: int = 32
    """Images held in memory at once, at most a batch; gradients add up to those of a whole batch, batch norm sees one
    micro-batch at a time."""
    learning_rate: float = 1e-4
    """Adam's learning rate for encoder and heads."""
    matrix_learning_rate: float = 0.0
    """Muon's learning rate for the matrices and convolutions of encoder and heads, whose other parameters stay with
    Adam; 0: Adam moves them all."""
    critic_learning_rate: float = 1e-6
    """Adam's learning rate for the critic."""
    warm_up_steps: int = 0
    """Steps over which learning rates rise linearly from 0."""
    final_learning_rate: float = 1.0
    """Fraction of the learning rates that is left at the end of the budget, approached along a cosine; 1 keeps them
    constant."""
    image_weight: float = 0.01
    """Weight of the squared image error, summed over pixels and channels."""
    critic_weight: float = 10.0
    """Weight of the curiosity term."""
    gradient_penalty: float = 0.0
    """R1: weight of the critic's squared gradient at data images; 0 is off."""
    gradient_penalty_every: int = 1
    """Steps between penalties, each weighted up by as many."""
    sleep_weight: float = 1.0
    """Weight of the error between the scene codes of renderings and the network's predictions for them."""
    sleep_noise: float = 0.5
    """Standard deviation of wake–sleep's scene codes around the network's own predictions, in half ranges."""
    swap_colors: bool = False
    """Show each image with its colour channels in a random order, and permute its true colours alike, in worlds where
    the result is a scene of the same world."""
    sleep_drawn: float = 0.5
    """Fraction of wake–sleep's scene codes that is drawn from the world's known range instead of around predictions;
    --method sleep draws all of them, and so does wake–sleep where the decoder is dense or reads crops."""
    self_training: float = 0.0
    """Fraction of the crop-pose stage's images that are crops of photographs; 0: none. Only where a world has
    photographs. An image loss compares renderings with them from the start. For --method sleep, their pseudo-labels are
    the network's own poses, refined by render-and-compare, and they are mixed in during the last two fifths of a run
    (the last four where it began with trained weights, --init)."""
    gradient_clip: float = 0.5
    """Largest L2 norm of a step's gradient, of the network and of the critic each."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Precision of the convolutions, bfloat16 only where the machine is quick with it; all else is in float32."""
    budget_images: int = 6_400_000
    """Images to show where neither --minutes nor --images is given."""

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
            if not 0 < getattr(self, name) < math.inf:
                raise UsageError(f"{_flag(name)} is {getattr(self, name)}, expected more than 0")
        for name in (
            "matrix_learning_rate",
            "critic_learning_rate",
            "warm_up_steps",
            "final_learning_rate",
            "image_weight",
            "critic_weight",
            "gradient_penalty",
            "sleep_weight",
            "sleep_noise",
        ):
            if not 0 <= getattr(self, name) < math.inf:
                raise UsageError(f"{_flag(name)} is {getattr(self, name)}, expected 0 or more")
        if not 0 <= self.sleep_drawn <= 1:
            raise UsageError(f"--sleep-drawn {self.sleep_drawn} is no fraction, expected 0 to 1")
        if not 0 <= self.self_training < 1:
            raise UsageError(f"--self-training {self.self_training}: expected 0 or more, and less than 1")
        if self.batch_size < 2 or self.micro_batch_size < 2:
            least = "--batch-size" if self.batch_size < 2 else "--micro-batch-size"
            raise UsageError(f"{least} is 1, expected 2 or more, because batch norm needs two images")
        if self.batch_size < self.micro_batch_size:  # --batch-size alone is given below the preset's micro-batch
            object.__setattr__(self, "micro_batch_size", self.batch_size)
        if self.batch_size % self.micro_batch_size:
            raise UsageError(
                f"--batch-size {self.batch_size} cannot be cut into micro-batches of {self.micro_batch_size}; "
                "expected --micro-batch-size to divide it"
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
    """The preset's hyperparameters for a world."""
    return replace(PRESETS[preset], **world.default_recipe) if preset == "laptop" else PRESETS[preset]


@dataclass(frozen=True)
class RunConfig:
    """All that decides what a run learns; ``config.json`` of its folder."""

    world: OmitArgPrefixes[WorldOptions]
    """The world's own options."""
    method: MethodName = "our"
    """our: image loss and critic. noncur: image loss alone. super: true scene codes. Beyond the paper, sleep: regress
    the scene codes of renderings, drawn from the world's known range. wake_sleep: image loss, and sleep with half of
    the codes around own predictions. wake_sleep_critic: that and the critic. hypotheses: image loss minimised over many
    rendered hypotheses of each image before training. templates: no training; renderings of the object are compared
    with frames by pretrained features."""
    labels: float = 1.0
    """Fraction of the training images that --method super sees, with their true codes (paper: 0.05, 0.1, 1)."""
    preset: Preset = "laptop"
    """Hyperparameters to start from: laptop (measured on two cores) or paper (the paper's)."""
    seed: int = 0
    """Seed of the initial weights and every random draw."""
    minutes: float | None = None
    """Budget of training time, in minutes; templates that are drawn before the first step count, too."""
    images: int | None = None
    """Budget of images shown. Where both budgets are given the first to be reached ends the run."""
    stop_below: float = 0.0
    """Converged, and done, when the image loss (summed squared error an image, smoothed) is below this; 0 never is."""
    recipe: OmitArgPrefixes[Recipe] = PRESETS["laptop"]
    """Hyperparameters; the preset's unless given."""
    network: OmitArgPrefixes[NetworkConfig] = NetworkConfig()
    """Sizes of the networks; the paper's unless given."""
    init: Path | None = None
    """Run folder, model folder (its latest version) or version's folder whose network to begin with instead of random
    weights. It must be of this world's kind, but its object may be another: features that were learned from one object
    shorten the training of the next."""

    def __post_init__(self) -> None:
        """Make the path of the first network absolute, and refuse what contradicts itself."""
        if self.init is not None:
            object.__setattr__(self, "init", self.init.absolute())
        if self.seed < 0:
            raise UsageError(f"--seed is {self.seed}, expected 0 or more")
        if not 0 < self.labels <= 1:
            raise UsageError(f"--labels {self.labels} is no fraction, expected more than 0 and at most 1")
        if self.labels != 1 and self.method != "super":
            raise UsageError(
                f"--labels {self.labels} with --method {self.method}, which uses none; expected --method super"
            )
        if not 0 <= self.stop_below < math.inf:
            raise UsageError(f"--stop-below is {self.stop_below}, expected 0 or more")
        if self.stop_below and not self.terms.image:
            raise UsageError(f"--stop-below watches the image loss, which --method {self.method} does not have")
        for name in ("minutes", "images"):
            if getattr(self, name) is not None and not getattr(self, name) > 0:
                raise UsageError(f"{_flag(name)} is {getattr(self, name)}, expected more than 0")

    @property
    def terms(self) -> Method:
        """Loss terms of the method."""
        return METHODS[self.method]

    def progress(self, images: int, seconds: float) -> float:
        """Fraction of the budget that is spent; 1 or more when it is used up."""
        if self.images is None and self.minutes is None:
            return images / self.recipe.budget_images
        by_images = images / self.images if self.images is not None else 0.0
        by_time = seconds / (60 * self.minutes) if self.minutes is not None else 0.0
        return max(by_images, by_time)


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")
