"""Every number a training run may be asked to change, as plain data without torch.

The command line, ``config.json`` of a run folder and the loop read these same classes.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeVar

from curio_train.errors import UsageError

Term = Literal["image", "critic", "sleep", "label"]
Method = Literal["our", "noncur", "super", "wake_sleep", "wake_sleep_critic"]
Preset = Literal["laptop", "paper"]
T = TypeVar("T")

METHODS: Mapping[Method, frozenset[Term]] = {
    "our": frozenset({"image", "critic"}),
    "noncur": frozenset({"image"}),
    "super": frozenset({"label"}),
    "wake_sleep": frozenset({"image", "sleep"}),
    "wake_sleep_critic": frozenset({"image", "critic", "sleep"}),
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
        row: Values each object slot gets from the shared trunk.
        hidden: Width of each branch's hidden layer.
    """

    encoder: ConvStack = ConvStack((64, 192, 384, 256, 64), (11, 5, 3, 3, 3), (4, 2, 2, 2, 2), (0, 1, 1, 1, 0))
    critic: ConvStack = ConvStack((64, 192, 384, 256, 1), (11, 5, 3, 3, 3), (4, 4, 2, 2, 2), (0, 0, 1, 1, 1))
    critic_normalisation: Literal["batch", "instance"] = "batch"
    row: int = 32
    hidden: int = 64
