"""Confidence calibration, and AUROC of telling frames with the object from frames without."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize

NUM_BINS = 10
_REGULARISATION = 1e-4
_CEILING_LOGIT, _HIGHEST_CEILING_LOGIT = 3.0, 8.0  # where nothing tells one: 0.95; and one that is none
_PAIR_REGULARISATION = 1e-3  # towards the confidence as it is: pairs say less than truth does
_LEAST_WEIGHT = 0.1  # surer answers stay surer


def calibration_error(confidences: Sequence[float], correct: Sequence[bool]) -> float:
    """Expected calibration error (Naeini et al. 2015) in ten equal bins: mean |confidence - fraction correct|.

    Args:
        confidences: In [0, 1].
        correct: Whether each prediction was.

    Raises:
        ValueError: There are no predictions.
    """
    if len(confidences) == 0:
        raise ValueError("calibration of no confidences: there must be at least one")
    gaps = [
        bin_["count"] * abs(bin_["confidence"] - bin_["correct"]) for bin_ in reliability_bins(confidences, correct)
    ]
    return float(sum(gaps) / len(confidences))


def reliability_bins(confidences: Sequence[float], correct: Sequence[bool]) -> list[dict[str, float]]:
    """The ten equal bins of confidence that are not empty, lowest first.

    Args:
        confidences: In [0, 1].
        correct: Whether each prediction was.

    Returns:
        Of each bin its borders ``from`` and ``to``, the ``count`` of predictions in it, their mean ``confidence``, and
        the fraction ``correct``.
    """
    found, hits = np.asarray(confidences, dtype=np.float64), np.asarray(correct, dtype=np.float64)
    bins = np.minimum((found * NUM_BINS).astype(int), NUM_BINS - 1)
    return [
        {
            "from": number / NUM_BINS,
            "to": (number + 1) / NUM_BINS,
            "count": int((bins == number).sum()),
            "confidence": float(found[bins == number].mean()),
            "correct": float(hits[bins == number].mean()),
        }
        for number in np.unique(bins).tolist()
    ]


def fit_calibration(features: ArrayLike, correct: Sequence[bool]) -> list[float]:
    """Logistic regression from features to the probability of being correct (Platt 1999).

    A few hundred predictions determine a few numbers. No weight is negative, because every feature should raise the
    probability.

    Args:
        features: [predictions, features], logits or the like.
        correct: Whether each prediction was.

    Returns:
        A weight for each feature, then the offset.
    """
    found, hits = np.asarray(features, dtype=np.float64), np.asarray(correct, dtype=np.float64)
    found = np.concatenate([found, np.ones((len(found), 1))], axis=1)
    start = np.eye(1, found.shape[1])[0]

    def loss(weights: np.ndarray) -> float:
        logits = found @ weights
        # Regularised towards the first feature alone: predictions may be too few, or separable.
        penalty = _REGULARISATION * np.square(weights - start).sum()
        return float(np.mean(np.logaddexp(0, logits) - hits * logits) + penalty)

    bounds = [(0.0, None)] * (len(start) - 1) + [(None, None)]
    weights: list[float] = minimize(loss, start, method="L-BFGS-B", bounds=bounds).x.tolist()
    return weights


def fit_calibration_below_ceiling(features: ArrayLike, correct: Sequence[bool]) -> tuple[list[float], float]:
    """Logistic regression whose probability ends below 1 (Barton and Lord 1981, upper asymptote).

    Some predictions are wrong for reasons that no feature shows, so that the surest are right in a part of the cases
    alone. Of a mere logistic regression they would get 1.

    Args:
        features: As of :func:`fit_calibration`.
        correct: Whether each prediction was.

    Returns:
        The weights as of :func:`fit_calibration`, and the ceiling by which the sigmoid is multiplied.
    """
    found, hits = np.asarray(features, dtype=np.float64), np.asarray(correct, dtype=np.float64)
    start = np.array([*fit_calibration(found, correct), _CEILING_LOGIT])
    usual = np.zeros(len(start))
    usual[0], usual[-1] = 1, _CEILING_LOGIT
    found = np.concatenate([found, np.ones((len(found), 1))], axis=1)

    def loss(weights: np.ndarray) -> float:
        right = -np.logaddexp(0, -found @ weights[:-1]) - np.logaddexp(0, -weights[-1])  # log of the probability
        right = np.minimum(right, -1e-9)
        likelihood = hits * right + (1 - hits) * np.log(-np.expm1(right))
        return float(_REGULARISATION * np.square(weights - usual).sum() - likelihood.mean())

    bounds = [(0.0, None)] * (len(start) - 2) + [(None, None), (None, _HIGHEST_CEILING_LOGIT)]
    *weights, ceiling = minimize(loss, start, method="L-BFGS-B", bounds=bounds).x.tolist()
    return weights, float(1 / (1 + np.exp(-ceiling)))


def fit_pair_calibration(logits: ArrayLike, agree: Sequence[bool]) -> tuple[float, float]:
    """A calibration of confidence by answers that are compared with each other, without any truth.

    Two answers about one pose agree where both are correct, and hardly ever else: with independent errors this has the
    product of their probabilities. Weight and offset of the logit are those of the greatest likelihood. What all
    answers get wrong alike is not seen.

    Args:
        logits: [pairs, 2], of the two answers' confidences.
        agree: Whether the two say the same pose.

    Returns:
        The weight, above 0, and the offset.
    """
    found, hits = np.asarray(logits, dtype=np.float64), np.asarray(agree, dtype=np.float64)
    start = np.array([1.0, 0.0])

    def loss(weights: np.ndarray) -> float:
        both = -np.logaddexp(0, -(weights[0] * found + weights[1])).sum(axis=1)  # log of the product
        both = np.minimum(both, -1e-9)
        likelihood = hits * both + (1 - hits) * np.log(-np.expm1(both))
        return float(_PAIR_REGULARISATION * np.square(weights - start).sum() - likelihood.mean())

    weight, offset = minimize(loss, start, method="L-BFGS-B", bounds=[(_LEAST_WEIGHT, None), (None, None)]).x.tolist()
    return weight, offset


def auroc(with_object: Sequence[float], without: Sequence[float]) -> float:
    """AUROC: how often a frame with the object has the higher confidence than one without; ties count half.

    Raises:
        ValueError: One of the two is empty.
    """
    if len(with_object) == 0 or len(without) == 0:
        raise ValueError("AUROC needs frames with the object and frames without")
    from scipy.stats import rankdata  # a third of a second, which training need not wait for

    ranks = rankdata([*with_object, *without])[: len(with_object)]
    return float((ranks.sum() / len(with_object) - (len(with_object) + 1) / 2) / len(without))
