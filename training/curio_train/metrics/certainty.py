"""Whether a confidence means what it says: calibration, and telling frames with the object from frames without."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize
from scipy.stats import rankdata

NUM_BINS = 10
_PULL = 1e-4


def calibration_error(confidences: Sequence[float], right: Sequence[bool]) -> float:
    """Expected calibration error (Naeini et al. 2015): mean distance of confidence and share right, in ten equal bins.

    Args:
        confidences: In [0, 1].
        right: Whether each prediction was.

    Raises:
        ValueError: There is nothing to judge.
    """
    found, hits = np.asarray(confidences, dtype=np.float64), np.asarray(right, dtype=np.float64)
    if len(found) == 0:
        raise ValueError("calibration of no confidences: there must be at least one")
    bins = np.minimum((found * NUM_BINS).astype(int), NUM_BINS - 1)
    gaps = [abs((found - hits)[bins == number].sum()) for number in range(NUM_BINS)]
    return float(sum(gaps) / len(found))


def calibration(signs: ArrayLike, right: Sequence[bool]) -> list[float]:
    """Weights of signs, and an offset, that make their sum the logit of being right (Platt 1999; logistic regression).

    A few numbers from a few hundred predictions. No weight is negative: a sign never speaks against what it is for.

    Args:
        signs: [predictions, signs], logits or the like.
        right: Whether each prediction was.

    Returns:
        A weight for each sign, then the offset.
    """
    found, hits = np.asarray(signs, dtype=np.float64), np.asarray(right, dtype=np.float64)
    found = np.concatenate([found, np.ones((len(found), 1))], axis=1)
    start = np.eye(1, found.shape[1])[0]

    def loss(weights: np.ndarray) -> float:
        logits = found @ weights
        # A little pull towards the first sign as it is, where too few are right or wrong to tell, or a sign tells all.
        pull = _PULL * np.square(weights - start).sum()
        return float(np.mean(np.logaddexp(0, logits) - hits * logits) + pull)

    bounds = [(0.0, None)] * (len(start) - 1) + [(None, None)]
    weights: list[float] = minimize(loss, start, method="L-BFGS-B", bounds=bounds).x.tolist()
    return weights


def auroc(with_object: Sequence[float], without: Sequence[float]) -> float:
    """AUROC: how often a frame with the object has the higher confidence than one without; ties count half.

    Raises:
        ValueError: One of the two is empty.
    """
    if len(with_object) == 0 or len(without) == 0:
        raise ValueError("separation needs frames with the object and frames without")
    ranks = rankdata([*with_object, *without])[: len(with_object)]
    return float((ranks.sum() / len(with_object) - (len(with_object) + 1) / 2) / len(without))
