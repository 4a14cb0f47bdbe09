"""How much two sets of outputs differ: those of torch and of onnxruntime have to agree."""

import numpy as np
from torch import Tensor

from curio_train.errors import ExportError

LARGEST_PARITY_ERROR = 1e-4
"""Largest absolute difference between torch and onnxruntime that an export may have, in any output."""


def largest_difference(one: dict[str, Tensor], other: dict[str, Tensor]) -> float:
    """Largest absolute difference of two sets of outputs; infinite where one is not finite or shapes differ.

    An output without a value differs by 0: of many objects one is unstable in each image, and with it what an image has
    once.
    """
    largest = 0.0
    for name, values in one.items():
        if name not in other or values.shape != other[name].shape:
            return float("inf")
        if values.numel():
            difference = (values.double() - other[name].double()).abs().max().item()
            largest = max(largest, difference if np.isfinite(difference) else float("inf"))
    return largest


def refuse_disparity(expected: dict[str, Tensor], found: dict[str, Tensor]) -> float:
    """The parity error.

    Raises:
        ExportError: It is too large; says in which output.
    """
    errors = {name: largest_difference({name: values}, found) for name, values in expected.items()}
    worst = max(errors, key=lambda name: errors[name])
    if errors[worst] > LARGEST_PARITY_ERROR:
        raise ExportError(
            f"torch and onnxruntime differ by {errors[worst]:.3g} in {worst}, expected at most "
            f"{LARGEST_PARITY_ERROR:g}; nothing was written. Has the training diverged, or hardly begun?"
        )
    return errors[worst]
