"""Steps of alignments that are part of exported graphs: plain arithmetic, without a solver."""

import torch
from jaxtyping import Float
from torch import Tensor

_CROSS = [[0.0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0]]
"""A vector times this is its cross-product matrix, row by row."""


def solve(matrix: Float[Tensor, "batch n n"], right: Float[Tensor, "batch n"]) -> Float[Tensor, "batch n"]:
    """Solve by Gauss–Jordan elimination, written out: a positive definite matrix needs no pivots."""
    count = matrix.shape[1]
    identity = torch.eye(count, dtype=matrix.dtype, device=matrix.device)
    system = torch.cat([matrix, right[..., None]], dim=2)
    for number in range(count):
        here = slice(number, number + 1)  # a slice keeps dimensions, which saves an exported graph nodes
        row = system[:, here] / system[:, here, here]
        system = system - (system[:, :, here] - identity[:, here]) * row
    return system[:, :, count]


def turn(vector: Float[Tensor, "batch 3"]) -> Float[Tensor, "batch 3 3"]:
    """The rotation by a short rotation vector, by Cayley's formula."""
    half = vector / 2
    cross = (half @ vector.new_tensor(_CROSS)).unflatten(1, (3, 3))
    scale = 2 / (1 + half.square().sum(dim=1))
    identity = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return identity + scale[:, None, None] * (cross + cross @ cross)
