import numpy as np
import pytest
from curio_train.metrics.calibration import (
    auroc,
    calibration_error,
    fit_calibration,
    fit_calibration_below_ceiling,
    reliability_bins,
)


def test_a_confidence_that_is_right_as_often_as_it_says_has_no_error() -> None:
    assert calibration_error([0.75] * 4 + [0.0] * 2, [True, True, True, False, False, False]) == pytest.approx(0)


def test_error_by_hand() -> None:
    """Bin 0.9: two, both wrong: off by 0.95 each. Bin 0.2: two, one right: 0.5 against 0.25."""
    assert calibration_error([0.95, 0.95, 0.25, 0.25], [False, False, True, False]) == pytest.approx(
        (2 * 0.95 + 2 * 0.25) / 4
    )
    assert calibration_error([1.0], [True]) == 0


def test_auroc_counts_pairs() -> None:
    assert auroc([0.9, 0.8], [0.1, 0.2, 0.3]) == 1
    assert auroc([0.1], [0.9]) == 0
    assert auroc([0.5, 0.5], [0.5]) == 0.5
    assert auroc([0.2, 0.8], [0.5]) == 0.5
    random = np.random.default_rng(0)
    some, others = random.random(40), random.random(30)
    pairs = (some[:, None] > others).mean()
    assert auroc(some, others) == pytest.approx(pairs)


def test_nothing_to_judge_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one"):
        calibration_error([], [])
    with pytest.raises(ValueError, match="without"):
        auroc([0.5], [])


def test_calibration_mends_confidences_that_say_too_little() -> None:
    """Of predictions that say 0.3 nine in ten are right, of those that say 0.1 one in two."""
    confidences = [0.3] * 500 + [0.1] * 500
    right = [True] * 450 + [False] * 50 + [True] * 250 + [False] * 250
    logits = np.log(np.array(confidences) / (1 - np.array(confidences)))
    slope, offset = fit_calibration(logits[:, None], right)
    found = 1 / (1 + np.exp(-(slope * logits + offset)))
    assert found[0] == pytest.approx(0.9, abs=0.02)
    assert found[-1] == pytest.approx(0.5, abs=0.02)
    assert calibration_error(found, right) < 0.02


def test_calibration_weights_informative_features_and_none_negatively() -> None:
    """Of two features beside the logit one tells which predictions are correct, the other which are wrong."""
    random = np.random.default_rng(0)
    right = random.random(400) < 0.5
    noise = random.normal(size=(3, 400))
    logit, telling, misleading = noise[0], 3 * right + noise[1], noise[2] - 3 * right
    first, second, third, offset = fit_calibration(np.stack([logit, telling, misleading], axis=1), right.tolist())
    assert second > 1
    assert abs(first) < 0.3
    assert third == 0
    found = 1 / (1 + np.exp(-(first * logit + second * telling + offset)))
    assert found[right].mean() > 0.8 > 0.2 > found[~right].mean()


def test_calibration_stays_finite_where_all_is_right() -> None:
    weights = fit_calibration([[0.0], [0.4], [13.0]], [True] * 3)
    assert np.isfinite(weights).all()
    assert weights[0] > 0


def test_reliability_counts_every_prediction_once() -> None:
    bins = reliability_bins([0.0, 0.05, 0.51, 0.59, 1.0], [False, True, True, True, True])
    assert [(b["from"], b["to"], b["count"]) for b in bins] == [(0.0, 0.1, 2), (0.5, 0.6, 2), (0.9, 1.0, 1)]
    assert [b["correct"] for b in bins] == [0.5, 1.0, 1.0]
    assert [b["confidence"] for b in bins] == pytest.approx([0.025, 0.55, 1.0])


def test_the_surest_predictions_can_be_right_in_a_part_of_the_cases() -> None:
    random = np.random.default_rng(3)
    logit = random.normal(size=3000) * 3
    probability = 0.6 / (1 + np.exp(-2 * logit - 1))
    right = random.random(3000) < probability
    (slope, offset), ceiling = fit_calibration_below_ceiling(logit[:, None], right.tolist())
    assert ceiling == pytest.approx(0.6, abs=0.05)
    assert (slope, offset) == pytest.approx((2, 1), abs=0.5)
    found = ceiling / (1 + np.exp(-slope * logit - offset))
    slope, offset = fit_calibration(logit[:, None], right.tolist())
    assert calibration_error(found.tolist(), right.tolist()) < 0.03
    assert calibration_error((1 / (1 + np.exp(-slope * logit - offset))).tolist(), right.tolist()) > 0.05


def test_few_predictions_tell_no_ceiling() -> None:
    weights, ceiling = fit_calibration_below_ceiling([[0.0], [0.4], [13.0]], [True] * 3)
    assert np.isfinite(weights).all()
    assert ceiling > 0.9
