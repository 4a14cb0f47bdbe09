"""Exchanged channels: image and code stay each other's, and nothing else changes."""

import pytest
import torch
from curio_train.learning.recoloring import recolored
from curio_train.scene_code import COLOR
from curio_train.worlds import WORLDS, build
from curio_train.worlds.base import Batch


@pytest.mark.parametrize("name", ["spheres", "varied", "multi", "light"])
def test_the_recoloured_scene_looks_like_the_recoloured_image(name: str) -> None:
    world = build(WORLDS[name]())
    assert world.colors_interchangeable
    code = world.sample(12, (3,))
    images = world.render(code)
    changed = recolored(Batch(images, code=code), (0, 5))
    assert changed.code is not None
    assert (world.render(changed.code) - changed.images).abs().max() < 1e-4
    assert not torch.equal(changed.code[COLOR], code[COLOR])
    assert all(torch.equal(changed.code[field], code[field]) for field in code if field != COLOR)
    same = recolored(Batch(images), (0, 5))
    assert same.code is None
    assert torch.equal(same.images, changed.images)
    assert not torch.equal(recolored(Batch(images), (0, 6)).images, changed.images)


def test_all_orders_of_the_channels_are_drawn() -> None:
    images = torch.tensor([0.1, 0.2, 0.3]).view(1, 3, 1, 1).expand(300, 3, 2, 2)
    found = {tuple(image[:, 0, 0].tolist()) for image in recolored(Batch(images), (1,)).images}
    assert len(found) == 6


@pytest.mark.parametrize("name", ["circles", "chairs"])
def test_worlds_whose_colours_mean_something_keep_them(name: str) -> None:
    assert not build(WORLDS[name]()).colors_interchangeable
