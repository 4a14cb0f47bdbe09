"""Eq. 1 and the errors of each parameter, on scenes small enough for pencil and paper."""

import math

import numpy as np
import pytest
import torch
from curio_train.data.bop import ModelInfo
from curio_train.metrics.assignment import (
    assign,
    canonical,
    each_parameter_error,
    nearest_alike,
    parameter_errors,
    scene_error,
)
from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION, YAW, Field, Layout

POSITION = Field(TRANSLATION, 3, unit="m", lower=(-1.0, -1.0, -1.0), upper=(1.0, 1.0, 1.0))
COLORS = Field(COLOR, 3, lower=(0.0, 0.0, 0.0), upper=(1.0, 1.0, 1.0))
CONFIDENCES = Field(CONFIDENCE, 1, lower=(0.0,), upper=(1.0,), activation="sigmoid")
POINTS = Layout((POSITION,), num_slots=2)
VARIED = Layout((POSITION, COLORS, CONFIDENCES), num_slots=3)


def positions(*rows: list[float]) -> dict[str, torch.Tensor]:
    return {TRANSLATION: torch.tensor([rows])}


def varied(xs: list[float], reds: list[float], confidences: list[float]) -> dict[str, torch.Tensor]:
    """Objects on the x axis, in shades of red."""
    zeros = torch.zeros(1, len(xs), 2)
    return {
        TRANSLATION: torch.cat([torch.tensor([xs])[..., None], zeros], dim=-1),
        COLOR: torch.cat([torch.tensor([reds])[..., None], zeros], dim=-1),
        CONFIDENCE: torch.tensor([confidences])[..., None],
    }


def test_same_scene_in_another_order_is_zero() -> None:
    a, b = positions([0.0, 0.0, 0.0], [0.5, 0.0, 0.0]), positions([0.5, 0.0, 0.0], [0.0, 0.0, 0.0])
    assert scene_error(POINTS, a, b).tolist() == [0]
    assert parameter_errors(POINTS, a, b) == {"position": 0}


def test_assignment_is_optimal_and_not_greedy() -> None:
    # The closest pair is (0.1, 0.2), but it would leave 0 and 1 for each other; the sum decides.
    predicted, true = positions([0.0, 0.0, 0.0], [0.3, 0.0, 0.0]), positions([0.2, 0.0, 0.0], [1.0, 0.0, 0.0])
    pairs = assign(POINTS, predicted, true)
    assert list(zip(pairs.predicted.tolist(), pairs.true.tolist(), strict=True)) == [(0, 0), (1, 1)]
    # Distances 0.2 and 0.7 m, over a range of 2 m.
    assert scene_error(POINTS, predicted, true).item() == pytest.approx(0.9 / 2)
    assert parameter_errors(POINTS, predicted, true)["position"] == pytest.approx(0.45)


def test_assignment_by_position_alone() -> None:
    # Colour says the opposite; it must not be asked, and then both colours are wrong by 1.
    predicted, true = (
        varied([0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]),
        varied([0.0, 1.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]),
    )
    predicted[TRANSLATION][0, 2, 1] = 0.9
    assert scene_error(VARIED, predicted, true).item() == pytest.approx(2)
    assert parameter_errors(VARIED, predicted, true)["color_mse"] == pytest.approx(2 / 6)


def test_surplus_prediction_costs_its_squared_confidence() -> None:
    true = varied([0.0, 0.5, 0.0], [0.0, 0.0, 0.0], [1.0, 1.0, 0.0])
    predicted = varied([0.5, -0.9, 0.0], [0.0, 0.0, 0.0], [1.0, 0.3, 0.8])
    # Pairs: 0.5 and 0 exactly, the second with confidence 0.8 instead of 1; left over: confidence 0.3.
    assert scene_error(VARIED, predicted, true).item() == pytest.approx(0.2 + 0.3**2)
    errors = parameter_errors(VARIED, predicted, true)
    assert errors == pytest.approx({"position": 0, "color_mse": 0, "confidence_mse": (0.2**2 + 0.3**2) / 3})


def test_absent_objects_do_not_attract() -> None:
    true = varied([0.8, 0.0, -0.8], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0])
    predicted = varied([0.0, -0.8, 0.7], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    assert assign(VARIED, predicted, true).predicted.tolist() == [2]
    assert scene_error(VARIED, predicted, true).item() == pytest.approx(0.05)


def test_missing_object_costs_one() -> None:
    predicted, true = positions([0.5, 0.0, 0.0]), positions([0.0, 0.0, 0.0], [0.5, 0.0, 0.0])
    pairs = assign(POINTS, predicted, true)
    assert pairs.missing.tolist() == [[True, False]]
    assert scene_error(POINTS, predicted, true).item() == pytest.approx(1)
    # Without a confidence field a prediction is certain of its object.
    assert scene_error(POINTS, true, predicted).item() == pytest.approx(1)


def test_empty_scene() -> None:
    true, predicted = (
        varied([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
        varied([0.4, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 0.1, 0.0]),
    )
    assert scene_error(VARIED, predicted, true).item() == pytest.approx(0.25 + 0.01)
    errors = parameter_errors(VARIED, predicted, true)
    assert math.isnan(errors["position"])
    assert errors["confidence_mse"] == pytest.approx(0.26 / 3)


def test_slots_with_a_shape_keep_to_it() -> None:
    predicted, true = positions([0.0, 0.0, 0.0], [1.0, 0.0, 0.0]), positions([1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    assert scene_error(POINTS, predicted, true).item() == 0
    assert scene_error(POINTS, predicted, true, groups=[(0,), (1,)]).item() == pytest.approx(1)
    assert parameter_errors(POINTS, predicted, true, groups=[(0,), (1,)]) == {"position": 1}


def test_images_are_paired_apart() -> None:
    a = {TRANSLATION: torch.tensor([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]])}
    b = {TRANSLATION: torch.tensor([[[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], [[0.0, 0.0, 0.6], [1.0, 0.0, 0.0]]])}
    assert scene_error(POINTS, a, b).tolist() == pytest.approx([0.0, 0.3])
    assert parameter_errors(POINTS, a, b)["position"] == pytest.approx(0.6 / 4)


def test_rotations_count_as_rotations() -> None:
    yaw = Layout((POSITION, Field(YAW, 2)))
    true = {**positions([0.0, 0.0, 0.0]), YAW: torch.tensor([[[1.0, 0.0]]])}
    longer = {**true, YAW: torch.tensor([[[7.0, 0.0]]])}
    quarter = {**true, YAW: torch.tensor([[[0.0, 0.2]]])}
    assert scene_error(yaw, longer, true).item() == 0
    assert scene_error(yaw, quarter, true).item() == pytest.approx(2**0.5)
    assert parameter_errors(yaw, quarter, true)["rotation_deg"] == pytest.approx(90)
    full = Layout((POSITION, Field(ROTATION_6D, 6)))
    true = {**positions([0.0, 0.0, 0.0]), ROTATION_6D: torch.tensor([[[1.0, 0.0, 0.0, 0.0, 1.0, 0.0]]])}
    skewed = {**true, ROTATION_6D: torch.tensor([[[3.0, 0.0, 0.0, 5.0, 2.0, 0.0]]])}
    half = {**true, ROTATION_6D: torch.tensor([[[-1.0, 0.0, 0.0, 0.0, 1.0, 0.0]]])}
    assert scene_error(full, skewed, true).item() == pytest.approx(0, abs=1e-6)
    assert parameter_errors(full, half, true)["rotation_deg"] == pytest.approx(180)
    assert canonical(skewed)[ROTATION_6D].flatten().tolist() == pytest.approx([1.0, 0.0, 0.0, 0.0, 1.0, 0.0])


def test_yaws_that_are_multiples_of_angles() -> None:
    """Codes that are off by 60 degrees: of a part without symmetry, of a hexagonal one, and of a round one."""
    layout = Layout((POSITION, Field(YAW, 2)), num_slots=3)
    places = positions([0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [1.0, 0.0, 0.0])
    true = {**places, YAW: torch.tensor([[[1.0, 0.0]] * 3])}
    predicted = {**places, YAW: torch.tensor([[[0.5, 0.75**0.5]] * 3])}
    folds = torch.tensor([1, 6, 0])
    errors = each_parameter_error(layout, predicted, true, yaw_folds=folds)["rotation_deg"]
    assert errors.tolist() == pytest.approx([60, 10, 0], abs=1e-4)
    assert each_parameter_error(layout, predicted, true)["rotation_deg"].tolist() == pytest.approx([60] * 3, abs=1e-4)
    swapped = {name: value.flip(1) for name, value in predicted.items()}
    errors = each_parameter_error(layout, swapped, true, yaw_folds=folds)["rotation_deg"]
    assert sorted(errors.tolist()) == pytest.approx([0, 10, 60], abs=1e-4)


def test_a_rotation_that_looks_alike_is_found_for_each_pair() -> None:
    """Half a turn about z is none of the second object, wherever the prediction has its slot."""
    half = np.diag([-1.0, -1.0, 1.0, 1.0])
    infos = [ModelInfo(0.1), ModelInfo(0.1, (half,))]
    layout = Layout((POSITION, Field(ROTATION_6D, 6)), num_slots=2)
    true = positions([0.0, 0.0, 0.0], [0.5, 0.0, 0.0]) | {ROTATION_6D: torch.eye(3)[:2].flatten().expand(1, 2, 6)}
    predicted = {**positions([0.5, 0.0, 0.0], [0.0, 0.0, 0.0]), ROTATION_6D: -true[ROTATION_6D]}
    alike = nearest_alike(layout, predicted, true, infos)
    assert torch.allclose(alike[ROTATION_6D], torch.stack([true[ROTATION_6D][:, 0], -true[ROTATION_6D][:, 0]], dim=1))
    apart = nearest_alike(layout, predicted, true, infos, groups=[(0,), (1,)])
    assert torch.equal(apart[ROTATION_6D], alike[ROTATION_6D])


@pytest.mark.parametrize(
    ("predicted", "true", "degrees"),
    [
        ([0.0, 0.0], [1.0, 0.0], 45),
        ([1.0, 0.0], [-1.0, 0.0], 90),
        ([0.0, 0.0, 5.0], [0.0, 2.0, 0.0], 90),
        ([1.0, 0.0, 0.0], [3.0, 0.0, 0.0], 0),
    ],
)
def test_light(predicted: list[float], true: list[float], degrees: float) -> None:
    layout = Layout((POSITION, Field(LIGHT, len(true), per_object=False)))
    a = {**positions([0.0, 0.0, 0.0]), LIGHT: torch.tensor([predicted])}
    b = {**positions([0.0, 0.0, 0.0]), LIGHT: torch.tensor([true])}
    assert parameter_errors(layout, a, b)["light_deg"] == pytest.approx(degrees, abs=1e-5)
    assert scene_error(layout, a, b).item() == pytest.approx(math.dist(predicted, true))


def test_scene_without_a_range_in_one_direction() -> None:
    flat = Layout((Field(TRANSLATION, 3, unit="image_width", lower=(-0.5, -0.5, 0.0), upper=(0.5, 0.5, 0.0)),))
    error = scene_error(flat, positions([0.3, 0.4, 0.0]), positions([0.0, 0.0, 0.0]))
    assert error.item() == pytest.approx(0.5)


def test_gradient_is_finite_at_the_truth_and_leads_there() -> None:
    true = varied([0.0, 0.5, 0.0], [0.2, 0.4, 0.0], [1.0, 1.0, 0.0])
    at_truth = {name: value.clone().requires_grad_() for name, value in true.items()}
    scene_error(VARIED, at_truth, true).sum().backward()
    assert all(torch.isfinite(value.grad).all() for value in at_truth.values())
    predicted = {name: value.clone() for name, value in true.items()}
    predicted[TRANSLATION][0, 1, 0] = 0.6
    predicted[TRANSLATION].requires_grad_()
    scene_error(VARIED, predicted, true).sum().backward()
    expected = torch.zeros(1, 3, 3)
    expected[0, 1, 0] = 0.5
    torch.testing.assert_close(predicted[TRANSLATION].grad, expected)
