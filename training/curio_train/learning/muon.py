"""Muon: momentum whose matrices are made orthogonal (Jordan et al. 2024, "Muon: An optimizer for hidden layers").

A weight matrix, or a convolution seen as one, moves equally far in every direction that its gradients span, instead of
mostly along the few that are steep. torch's own Muon takes matrices alone; here convolutions count as matrices
[out, in · height · width], and Adam moves everything else: biases and normalisation.
"""

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from curio_train.learning.hardware import quick_bfloat16

_MOMENTUM = 0.95
_COEFFICIENTS = (3.4445, -4.7750, 2.0315)  # of the quintic iteration, Jordan et al. 2024
_ITERATIONS = 5
_SMALLEST = 16
_BETAS, _EPSILON = (0.9, 0.999), 1e-8  # of Adam, as for every other network here


class Muon(Optimizer):
    """Muon for matrices, Adam for the rest; the two parameter groups have their own learning rates."""

    def __init__(self, parameters: Iterable[nn.Parameter], matrix_learning_rate: float, learning_rate: float) -> None:
        """Sort the parameters.

        Args:
            parameters: All of a network's.
            matrix_learning_rate: Length of a step of a matrix, as a root mean square per singular value.
            learning_rate: Adam's.
        """
        every = list(parameters)
        groups = [
            {"params": [p for p in every if _is_matrix(p)], "lr": matrix_learning_rate, "matrices": True},
            {"params": [p for p in every if not _is_matrix(p)], "lr": learning_rate, "matrices": False},
        ]
        super().__init__(groups, {})

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> None:  # type: ignore[override]
        """Move all parameters that have a gradient; ``closure`` is not called."""
        for group in self.param_groups:
            move = self._move_matrix if group["matrices"] else self._move_by_adam
            for parameter in group["params"]:
                if parameter.grad is not None:
                    move(parameter, parameter.grad, group["lr"])

    def _move_matrix(self, parameter: Tensor, gradient: Tensor, rate: float) -> None:
        state = self.state[parameter]
        if not state:
            state["momentum"] = torch.zeros_like(parameter)
        state["momentum"].lerp_(gradient, 1 - _MOMENTUM)
        update = orthogonal(gradient.lerp(state["momentum"], _MOMENTUM).flatten(1))
        taller = max(1.0, update.shape[0] / update.shape[1]) ** 0.5
        parameter.add_(update.view_as(parameter), alpha=-rate * taller)

    def _move_by_adam(self, parameter: Tensor, gradient: Tensor, rate: float) -> None:
        state = self.state[parameter]
        if not state:
            state |= {
                "step": torch.tensor(0.0),
                "mean": torch.zeros_like(parameter),
                "square": torch.zeros_like(parameter),
            }
        state["step"] += 1
        state["mean"].lerp_(gradient, 1 - _BETAS[0])
        state["square"].lerp_(gradient.square(), 1 - _BETAS[1])
        first, second = (1 - beta ** float(state["step"]) for beta in _BETAS)
        parameter.addcdiv_(state["mean"] / first, (state["square"] / second).sqrt() + _EPSILON, value=-rate)


def _is_matrix(parameter: Tensor) -> bool:
    """Whether Muon moves it; a map between few values has too few directions to balance."""
    return parameter.dim() > 1 and min(parameter.shape[0], parameter[0].numel()) >= _SMALLEST


def orthogonal(matrix: Tensor) -> Tensor:
    """Roughly U Vᵀ of a matrix U S Vᵀ, by Newton–Schulz iterations: singular values from 0.7 to 1.2."""
    tall = matrix.shape[0] > matrix.shape[1]
    # bfloat16 is precise enough for it.
    found = (matrix.T if tall else matrix).to(torch.bfloat16 if quick_bfloat16(matrix.device.type) else torch.float32)
    found = found / (found.norm() + 1e-7)
    a, b, c = _COEFFICIENTS
    for _ in range(_ITERATIONS):
        gram = found @ found.T
        found = a * found + (b * gram + c * gram @ gram) @ found
    return (found.T if tall else found).to(matrix.dtype)
