"""Steps of alignments that are part of exported graphs: plain arithmetic, without a solver."""

import torch
from jaxtyping import Float
from torch import Tensor

_CROSS = [[0.0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0]]
"""A vector times this is its cross-product matrix, row by row."""


def solve(matrix: Float[Tensor, "batch n n"], right: Float[Tensor, "batch n"]) -> Float[Tensor, "batch n"]:
    """Solve equations with a positive definite matrix."""
    return solve_augmented(torch.cat([matrix, right.unsqueeze(2)], dim=2))


def solve_augmented(system: Float[Tensor, "batch n n+1"]) -> Float[Tensor, "batch n"]:
    """Solve equations whose right side is the last column, by Gauss–Jordan elimination, written out.

    A positive definite matrix needs no pivots. ``narrow`` instead of slices, of which an export traces one for each
    dimension that stays whole, too.
    """
    count = system.shape[1]
    identity = torch.eye(count, dtype=system.dtype, device=system.device)
    for number in range(count):
        row, column = system.narrow(1, number, 1), system.narrow(2, number, 1)
        system = system - (column - identity.narrow(1, number, 1)) * (row / row.narrow(2, number, 1))
    return system.select(2, count)


def turn(vector: Float[Tensor, "batch 3"]) -> Float[Tensor, "batch 3 3"]:
    """The rotation by a short rotation vector, by Cayley's formula."""
    half = vector / 2
    cross = (half @ vector.new_tensor(_CROSS)).unflatten(1, (3, 3))
    scale = 2 / (1 + half.square().sum(dim=1))
    identity = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return identity + scale[:, None, None] * (cross + cross @ cross)
