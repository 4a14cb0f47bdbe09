"""Scenes that are found by image loss among rendered hypotheses, and the method that teaches them."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from curio_train.config import METHODS, NetworkConfig, Recipe, RunConfig
from curio_train.errors import CheckpointError, UsageError
from curio_train.learning.explaining import explained, search_of
from curio_train.learning.parallel import Ranks
from curio_train.learning.trainer import Trainer
from curio_train.metrics.assignment import each_parameter_error, scene_error
from curio_train.scene_code import CONFIDENCE, TRANSLATION, YAW
from curio_train.worlds import WORLDS, build
from curio_train.worlds.base import Explainer
from curio_train.worlds.generated.generated_world import GeneratedWorld
from curio_train.worlds.generated.hypotheses.descent import image_losses
from curio_train.worlds.image_sets import StoredImages
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.world import Object
from torch import Tensor

CELLS = NetworkConfig(reading="cells")


@functools.cache
def world_of(name: str) -> GeneratedWorld:
    world = build(WORLDS[name]())
    assert isinstance(world, GeneratedWorld)
    return world


@functools.cache
def explainer_of(name: str) -> Explainer:
    """That of a world, whose bank of renderings takes seconds."""
    return world_of(name).explainer()


@torch.no_grad()
def photographed(world: GeneratedWorld, code: dict[str, Tensor]) -> Tensor:
    return (world.render(code) * 255).round().byte()


def error(world: GeneratedWorld, found: dict[str, Tensor], code: dict[str, Tensor]) -> float:
    """Median of Eq. 1."""
    groups = tuple(kind.slots for kind in world.objects)
    return float(scene_error(world.layout, found, code, groups).median())


class Searched(NamedTuple):
    """Scenes, their images, and what was found by these."""

    code: dict[str, Tensor]
    images: Tensor
    found: dict[str, Tensor]


@pytest.fixture(scope="module")
def searched() -> Callable[[str], Searched]:
    """``searched(name)``: scenes of a world, searched once."""

    @functools.cache
    def search(name: str) -> Searched:
        code = world_of(name).sample(12 if name == "multi" else 8, (8,))
        images = photographed(world_of(name), code)
        return Searched(code, images, explainer_of(name).explain(images))

    return search


@pytest.mark.parametrize("name", ["chairs", "multi"])
def test_scenes_are_found_from_their_images_alone(searched: Callable[[str], Searched], name: str) -> None:
    world, (code, _, found) = world_of(name), searched(name)
    assert found[CONFIDENCE].mean() > 0.9  # both worlds show all of their objects
    assert error(world, found, code) < 0.3 * error(world, world.sample(len(code[TRANSLATION]), (6,)), code)


def test_a_sun_that_moves_is_found_with_the_scene() -> None:
    world = world_of("light")
    code = world.sample(2, (5,))
    found = world.explainer().explain(photographed(world, code))
    assert error(world, found, code) < 0.3 * error(world, world.sample(2, (6,)), code)
    off = each_parameter_error(world.layout, found, code)["light_deg"]
    assert off.median() < 2


def test_objects_that_explain_nothing_are_searched_for_again(
    searched: Callable[[str], Searched], monkeypatch: pytest.MonkeyPatch
) -> None:
    world, (_, images, found) = world_of("multi"), searched("multi")
    after = image_losses(world, found, images)
    monkeypatch.setattr("curio_train.worlds.generated.hypotheses.search._REACHES_M", ())
    before = image_losses(world, explainer_of("multi").explain(images), images)
    assert (after < before + 2).all()  # outlines are sampled: equal scenes differ by less
    assert after.mean() < 0.95 * before.mean()


def test_an_empty_image_has_no_objects() -> None:
    world = world_of("multi")
    code = world.sample(2, (0,)) | {CONFIDENCE: torch.zeros(2, world.layout.num_slots, 1)}
    found = explainer_of("multi").explain(photographed(world, code))
    assert found[CONFIDENCE].max() == 0


def test_found_objects_stand_on_the_ground_and_yaws_have_unit_length() -> None:
    world = world_of("chairs")
    found = explainer_of("chairs").explain(photographed(world, world.sample(4, (7,))))
    assert found[TRANSLATION][..., 1].abs().max() == 0
    assert torch.isfinite(found[YAW]).all()


@pytest.mark.parametrize("name", ["circles", "spheres", "varied"])
def test_worlds_without_objects_on_the_ground_are_refused(name: str) -> None:
    with pytest.raises(UsageError, match=f"{name} has no hypotheses here; expected chairs, multi, light, or linemod"):
        build(WORLDS[name]()).explainer()


def test_captures_are_refused(brick: Object, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"capture has no hypotheses here; expected .*linemod with one class"):
        search_of(TwoStageWorld("capture", brick), None, 0, tmp_path)


def test_only_methods_that_know_codes_calibrate_confidences_with_them() -> None:
    assert {name for name, terms in METHODS.items() if terms.knows_codes} == {
        "super",
        "sleep",
        "wake_sleep",
        "wake_sleep_critic",
    }


def test_other_decoders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="add --reading cells"):
        search_of(world_of("multi"), None, 0, tmp_path)


@pytest.mark.usefixtures("small_image_sets")
def test_the_method_learns_and_the_label_file_is_never_opened(tmp_path: Path) -> None:
    world, cache = world_of("chairs"), tmp_path / "cache"
    world.source("train", 0, with_code=True, cache=cache)
    (labels,) = cache.glob("chairs-*/train.codes.npz")
    labels.write_bytes(b"unreadable")
    images = StoredImages(
        world.source("train", 0, with_code=False, cache=cache).images[:8], None, seed=0, shuffle=False
    )
    found = images.with_code(explained(explainer_of("chairs"), images.images, tmp_path)[0])
    recipe = Recipe(batch_size=8, micro_batch_size=8, learning_rate=3e-3)
    config = RunConfig(WORLDS["chairs"](), method="hypotheses", network=CELLS, recipe=recipe)
    trainer = Trainer(config, world, [found], Ranks(0, 1, torch.device("cpu")))
    losses = [trainer.step(1.0)["hypotheses"] for _ in range(10)]
    assert losses[-1] < 0.9 * losses[0]


class Counting:
    """Finds nothing, and knows how many images it was asked about."""

    def __init__(self, world: GeneratedWorld) -> None:
        self.world, self.images = world, 0

    def explain(self, images: Tensor) -> dict[str, Tensor]:
        self.images += len(images)
        return self.world.sample(len(images), (1,))


def test_a_search_that_was_stopped_goes_on_with_the_images_that_are_left(tmp_path: Path) -> None:
    world = world_of("chairs")
    images = torch.zeros(250, 3, 8, 8, dtype=torch.uint8)
    _, seconds = explained(Counting(world), images, tmp_path)
    (tmp_path / "found" / "00200.npz").unlink()
    again = Counting(world)
    code, seconds_again = explained(again, images, tmp_path)
    assert again.images == 50
    assert len(code[TRANSLATION]) == 250
    assert seconds > 0
    assert seconds_again > 0  # those of the session before count


def test_a_full_disk_stops_the_search_with_what_to_do(tmp_path: Path) -> None:
    world, run = world_of("chairs"), tmp_path / "run"
    run.write_text("no folder")
    images = torch.zeros(1, 3, 8, 8, dtype=torch.uint8)
    with pytest.raises(CheckpointError, match="make room, then continue with --resume"):
        explained(Counting(world), images, run)
