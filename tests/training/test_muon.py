import pytest
import torch
from curio_train.learning.muon import Muon, orthogonal
from torch import nn


@pytest.mark.parametrize("shape", [(32, 32), (48, 20), (20, 48)])
def test_singular_values_come_near_one_and_directions_stay(shape: tuple[int, int]) -> None:
    torch.manual_seed(0)
    left, right = (
        torch.linalg.qr(torch.randn(shape[0], shape[0]))[0],
        torch.linalg.qr(torch.randn(shape[1], shape[1]))[0],
    )
    values = torch.zeros(shape)
    values.diagonal().copy_(torch.linspace(0.1, 3, min(shape)))
    found = left.T @ orthogonal(left @ values @ right.T) @ right
    assert found.diagonal().min() > 0.6
    assert found.diagonal().max() < 1.3
    off = found.clone()
    off.diagonal().zero_()
    assert off.abs().max() < 0.1, "directions were mixed"


def test_both_kinds_of_parameter_find_the_least_squares_solution() -> None:
    torch.manual_seed(0)
    wanted, layer = nn.Linear(24, 20), nn.Linear(24, 20)
    optimizer = Muon(layer.parameters(), 0.02, 0.02)
    assert [len(group["params"]) for group in optimizer.param_groups] == [1, 1]
    inputs = torch.randn(256, 24)
    target = wanted(inputs).detach()
    first = (layer(inputs) - target).square().mean().item()
    for step in range(150):
        for group in optimizer.param_groups:
            group["lr"] = 0.02 * (1 - step / 150)
        optimizer.zero_grad()
        (layer(inputs) - target).square().mean().backward()
        optimizer.step()
    assert (layer(inputs) - target).square().mean().item() < 0.01 * first


def test_parameters_without_a_gradient_stay() -> None:
    layer = nn.Linear(20, 20)
    before = layer.weight.detach().clone()
    optimizer = Muon(layer.parameters(), 0.1, 0.1)
    optimizer.step()
    assert torch.equal(layer.weight, before)
