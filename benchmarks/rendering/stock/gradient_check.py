"""How good are the gradients? Their cosine to central differences of a converged rendering, group by group.

For tests, benchmarks and whoever changes an estimator.
"""

from collections.abc import Callable, Mapping

import torch
from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, TRANSLATION
from torch import Tensor

TURN = "turn"
"""A small rotation in front of ``rotation``: axis · angle in radians, camera frame."""

STEPS: Mapping[str, float] = {TURN: 0.01, TRANSLATION: 0.0005, LIGHT: 0.02, COLOR: 0.01, CONFIDENCE: 0.01}
"""Half widths of the differences, metres and radians: about a quarter of a pixel for objects of a decimetre."""

Loss = Callable[[Mapping[str, Tensor]], Tensor]
"""From displacements [batch, …] of each group to one loss an image [batch]."""


def turned(rotation: Tensor, turn: Tensor) -> Tensor:
    """``exp([turn]×) · rotation``, differentiable at zero; shapes [..., 3, 3] and [..., 3]."""
    x, y, z = turn.unbind(-1)
    zero = torch.zeros_like(x)
    generator = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    return torch.matrix_exp(generator) @ rotation


def central_differences(loss: Loss, zeros: Mapping[str, Tensor], groups: list[str]) -> dict[str, Tensor]:
    """[batch, n] for each group; ``zeros`` are displacements of all groups, shaped [batch, …]."""
    found = {}
    with torch.no_grad():
        for name in groups:
            flat = torch.zeros_like(zeros[name]).flatten(1)
            columns = []
            for k in range(flat.shape[1]):
                ends = []
                for sign in (1, -1):
                    step = flat.clone()
                    step[:, k] = sign * STEPS[name]
                    ends.append(loss({**zeros, name: step.view_as(zeros[name])}))
                columns.append((ends[0] - ends[1]) / (2 * STEPS[name]))
            found[name] = torch.stack(columns, dim=1)
    return found


def gradients(loss: Loss, zeros: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """[batch, n] for each group, by backpropagation."""
    moved = {name: value.clone().requires_grad_() for name, value in zeros.items()}
    loss(moved).sum().backward()
    return {name: value.grad.flatten(1) for name, value in moved.items() if value.grad is not None}


def cosine(a: Tensor, b: Tensor) -> float:
    """Of two stacks of gradients, taken as one vector each."""
    return float(torch.nn.functional.cosine_similarity(a.double().flatten(), b.double().flatten(), dim=0))
