"""The oracle critic: its geometry against counting, its discrepancy against known densities, and that it helps."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from discs.validation_experiment import (
    ValidationSettings,
    discrepancy,
    image_error,
    overlap,
    solve,
)

QUICK = ValidationSettings(num_objects=60, num_steps=1500)


@pytest.mark.parametrize("offset", [0.0, 0.02, -0.05, 0.09, 0.1, 0.3])
def test_overlap_is_the_lens_of_two_discs(offset: float) -> None:
    axis = (np.arange(800) + 0.5) / 800 * 0.6 - 0.3
    x, y = np.meshgrid(axis, axis)
    first, second = x**2 + y**2 < 0.05**2, (x - offset) ** 2 + y**2 < 0.05**2
    assert overlap(torch.tensor(offset), 0.05).item() == pytest.approx((first & second).sum() / first.sum(), abs=5e-3)


def test_image_error_is_the_squared_difference_of_the_pictures() -> None:
    axis = (np.arange(800) + 0.5) / 800 * 0.6 - 0.3
    x, y = np.meshgrid(axis, axis)
    first, second = x**2 + y**2 < 0.05**2, (x - 0.03) ** 2 + y**2 < 0.05**2
    counted = ((0.8 * first - 0.5 * second) ** 2).sum() / first.sum()
    found = image_error(torch.tensor([[0.0, 0.8]]), torch.tensor([[0.03, 0.5]]), 0.05)
    assert found.item() == pytest.approx(counted, abs=5e-3)


def test_without_overlap_the_image_wants_black_and_nothing_else() -> None:
    guess = torch.tensor([[0.2, 0.6]], requires_grad=True)
    image_error(guess, torch.tensor([[0.7, 0.9]]), 0.05).sum().backward()
    assert guess.grad.tolist() == [[0.0, pytest.approx(1.2)]]


def test_discrepancy_of_an_even_grid_is_nothing_up_to_the_very_border() -> None:
    axis = (torch.arange(40) + 0.5) / 40
    grid = torch.cartesian_prod(axis, axis)
    samples = torch.cat([torch.rand(200, 2), torch.tensor([[0.0, 0.0], [1.0, 0.5], [0.5, 1.0]])])
    assert discrepancy(grid, samples, 0.1).item() < 1e-4
    assert discrepancy(grid * torch.tensor([1.0, 0.5]), samples, 0.1).item() > 0.1


def test_discrepancy_of_one_point_is_the_variance_of_its_kernel() -> None:
    samples = torch.rand(50, 2, generator=torch.Generator().manual_seed(0)) * 0.2 + 0.4
    density = [
        math.exp(-((a - 0.5) ** 2 + (b - 0.5) ** 2) / 0.0032) / (2 * math.pi * 0.0016) for a, b in samples.tolist()
    ]
    found = discrepancy(torch.tensor([[0.5, 0.5]]), samples, 0.04)
    assert found.item() == pytest.approx(np.var(density, ddof=1), rel=1e-4)


def test_curiosity_solves_problems_that_the_image_loss_alone_turns_black() -> None:
    without, curious = (solve(replace(QUICK, discrepancy_weight=weight), 0) for weight in (0.0, 0.3))
    assert torch.equal(without.truth, curious.truth)
    assert torch.equal(without.path[0], curious.path[0])
    assert without.share < 0.4
    lost = without.path[-1, ~without.solved]
    assert (lost[:, 1] < 0.05).double().mean() > 0.9
    assert curious.share > without.share + 0.3
    assert curious.path.min() >= 0
    assert curious.path.max() <= 1


def test_every_run_of_a_seed_is_the_same() -> None:
    short = replace(QUICK, num_steps=20)
    assert torch.equal(solve(short, 1).path, solve(short, 1).path)
    assert not torch.equal(solve(short, 1).path, solve(short, 2).path)


def test_groups_that_cannot_be_dealt_are_refused() -> None:
    with pytest.raises(ValueError, match="60 objects cannot be dealt into groups of 7"):
        solve(replace(QUICK, group_size=7), 0)
