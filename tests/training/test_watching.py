"""The scenes to watch learning in: discs where and as large as their code says, and moments that differ by loss."""

import math
from typing import get_args

import pytest
import torch
from curio_train.scene_code import COLOR, TRANSLATION
from discs.watching import BACKGROUND_SRGB, FAR, NEAR, RADIUS, Discs, Loss, Scene, watch


@pytest.mark.parametrize(("scene", "z", "radius"), [("5D", 1.5, RADIUS), ("6D", 1.0, 0.18), ("6D", 3.0, 0.06)])
def test_a_disc_is_where_and_as_large_as_its_code_says(scene: Scene, z: float, radius: float) -> None:
    code = {TRANSLATION: torch.tensor([[[0.1, -0.2, z]]]), COLOR: torch.tensor([[[1.0, 0.5, 0.0]]])}
    image = Discs(scene).render(code)[0]
    alpha = (image[0] - BACKGROUND_SRGB) / (1 - BACKGROUND_SRGB)
    assert alpha.mean().item() == pytest.approx(math.pi * radius**2, rel=0.02)
    axis = (torch.arange(64) - 31.5) / 64
    assert (alpha.sum(dim=0) @ axis / alpha.sum()).item() == pytest.approx(0.1, abs=2e-3)
    assert (alpha.sum(dim=1) @ axis / alpha.sum()).item() == pytest.approx(-0.2, abs=2e-3)
    middle = image[:, round(-0.2 * 64 + 31.5), round(0.1 * 64 + 31.5)]
    assert middle.tolist() == pytest.approx([1.0, 0.5, 0.0], abs=1e-6)


def test_six_dimensions_have_a_depth_and_five_have_not() -> None:
    flat, deep = (Discs(scene).sample(200, (0,))[TRANSLATION][..., 2] for scene in get_args(Scene))
    assert flat.tolist() == [[pytest.approx(1.5)]] * 200
    assert NEAR <= deep.min() < 1.1
    assert 2.9 < deep.max() <= FAR


def test_each_loss_goes_its_own_way_from_the_same_start() -> None:
    world = Discs("6D")
    images = world.render(world.sample(3, (9,)))
    told = {loss: list(watch(world, loss, images, num_steps=4, every=2)) for loss in get_args(Loss)}
    for moments in told.values():
        assert [moment.step for moment in moments] == [0, 2, 4]
        assert torch.equal(moments[0].rendered, told["image"][0].rendered)
        assert moments[-1].rendered.shape == images.shape
        assert not torch.equal(moments[-1].rendered, moments[0].rendered)
    ends = [moments[-1].rendered for moments in told.values()]
    assert not any(torch.equal(ends[a], ends[b]) for a, b in ((0, 1), (0, 2), (1, 2)))
