"""Scenes that are found by image loss among rendered hypotheses, and the method that teaches them."""

from pathlib import Path

import pytest
import torch
from curio_train.config import NetworkConfig, Recipe, RunConfig
from curio_train.errors import UsageError
from curio_train.learning.parallel import Ranks
from curio_train.learning.trainer import Trainer
from curio_train.metrics.assignment import scene_error
from curio_train.scene_code import CONFIDENCE, TRANSLATION, YAW
from curio_train.worlds import WORLDS, build
from curio_train.worlds.generated.generated_world import GeneratedWorld
from curio_train.worlds.image_sets import StoredImages
from torch import Tensor

CELLS = NetworkConfig(reading="cells")


def world_of(name: str) -> GeneratedWorld:
    world = build(WORLDS[name]())
    assert isinstance(world, GeneratedWorld)
    return world


@torch.no_grad()
def photographed(world: GeneratedWorld, code: dict[str, Tensor]) -> StoredImages:
    return StoredImages((world.render(code) * 255).round().byte(), None, seed=0, shuffle=False)


@pytest.mark.parametrize("name", ["chairs", "multi"])
def test_scenes_are_found_from_their_images_alone(name: str) -> None:
    world = world_of(name)
    code = world.sample(8, (5,))
    found = world.explained(photographed(world, code)).batch(0, 8).code
    assert found is not None
    assert found[CONFIDENCE].mean() > 0.9  # both worlds show all of their objects
    groups = tuple(kind.slots for kind in world.objects)
    drawn = world.sample(8, (6,))
    error, chance = (scene_error(world.layout, one, code, groups).median() for one in (found, drawn))
    assert error < 0.3 * chance


def test_an_empty_image_has_no_objects() -> None:
    world = world_of("multi")
    code = world.sample(2, (0,)) | {CONFIDENCE: torch.zeros(2, world.layout.num_slots, 1)}
    found = world.explained(photographed(world, code)).batch(0, 2).code
    assert found is not None
    assert found[CONFIDENCE].max() == 0


def test_found_objects_stand_on_the_ground_and_yaws_have_unit_length() -> None:
    world = world_of("chairs")
    found = world.explained(photographed(world, world.sample(4, (7,)))).batch(0, 4).code
    assert found is not None
    assert found[TRANSLATION][..., 1].abs().max() == 0
    assert torch.isfinite(found[YAW]).all()


@pytest.mark.parametrize("name", ["spheres", "light"])
def test_worlds_without_yaws_or_with_a_moving_sun_are_refused(name: str) -> None:
    world = world_of(name)
    with pytest.raises(UsageError, match=f"chairs and multi, and {name} is another world"):
        world.explained(photographed(world, world.sample(1, (0,))))


def test_other_decoders_are_refused() -> None:
    with pytest.raises(UsageError, match="add --reading cells"):
        RunConfig(WORLDS["multi"](), method="hypotheses")


def test_the_method_learns_and_the_label_file_is_never_opened(tmp_path: Path) -> None:
    world, cache = world_of("chairs"), tmp_path / "cache"
    world.source("train", 0, with_code=True, cache=cache)
    (labels,) = cache.glob("chairs-*/train.codes.npz")
    labels.write_bytes(b"unreadable")
    images = StoredImages(
        world.source("train", 0, with_code=False, cache=cache).images[:8], None, seed=0, shuffle=False
    )
    found = world.explained(images)
    recipe = Recipe(batch_size=8, micro_batch_size=8, learning_rate=3e-3)
    config = RunConfig(WORLDS["chairs"](), method="hypotheses", network=CELLS, recipe=recipe)
    trainer = Trainer(config, world, [found], Ranks(0, 1, torch.device("cpu")))
    losses = [trainer.step(1.0)["hypotheses"] for _ in range(10)]
    assert losses[-1] < 0.9 * losses[0]
