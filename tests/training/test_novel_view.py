"""The paper's two figures of a set of codes: Eq. 1 and DSSIM from a view that the network has not seen."""

import pytest
import torch
from curio_train.evaluation.scores import novel_view_dssim, scene_scores
from curio_train.metrics.images import dssim
from curio_train.scene_code import COLOR, TRANSLATION
from curio_train.worlds import WORLDS, build


@pytest.mark.parametrize("name", ["circles", "spheres", "light"])
def test_the_true_codes_have_no_error(name: str) -> None:
    world = build(WORLDS[name]())
    code = world.sample(60, (0,))  # more than are rendered at once
    scores = scene_scores(world, code, code)
    counted = {key: value for key, value in scores.items() if key != "rotation_deg"}
    assert counted == dict.fromkeys(counted, pytest.approx(0, abs=1e-6))
    assert scores.get("rotation_deg", 0) < 0.1
    assert ("scene_error_any_shape" in scores) == (name == "light")


def test_the_order_of_equal_slots_is_nothing() -> None:
    world = build(WORLDS["spheres"]())
    code = world.sample(8, (1,))
    turned = {name: value.roll(1, dims=1) for name, value in code.items()}
    scores = scene_scores(world, turned, code)
    assert scores["scene_error"] == pytest.approx(0, abs=1e-6)
    assert scores["novel_view_dssim"] < 0.01  # edges are jittered anew


def test_an_error_in_distance_is_small_in_the_seen_view_and_large_in_the_novel_one() -> None:
    world = build(WORLDS["spheres"]())
    code = world.sample(8, (2,))
    # Along its own ray and a tenth farther: nearly the same picture from the front.
    farther = {TRANSLATION: code[TRANSLATION] * 1.1, COLOR: code[COLOR]}
    seen = dssim(world.render(farther), world.render(code)).mean()
    assert novel_view_dssim(world, farther, code).mean() > 1.5 * seen


def test_a_shape_in_the_place_of_another_counts_where_shapes_do() -> None:
    world = build(WORLDS["multi"]())
    code = world.sample(4, (3,))
    places = code[TRANSLATION].clone()
    places[:, [0, 2]] = places[:, [2, 0]]  # a W where the X is, and the other way round
    turns = torch.tensor([2, 1, 0, 3, 4, 5, 6, 7])
    swapped = {name: value[:, turns] for name, value in code.items()} | {TRANSLATION: places}
    scores = scene_scores(world, swapped, code)
    assert scores["scene_error_any_shape"] == pytest.approx(0, abs=1e-6)
    assert scores["scene_error"] > 0.1
