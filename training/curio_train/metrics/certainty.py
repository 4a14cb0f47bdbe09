"""Whether a confidence means what it says: calibration, and telling frames with the object from frames without."""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize
from scipy.special import logit
from scipy.stats import rankdata

NUM_BINS = 10
_LEAST = 1e-6
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


def calibration(confidences: Sequence[float], right: Sequence[bool]) -> tuple[float, float]:
    """Slope and offset of the logit with which confidences become probabilities of being right (Platt 1999).

    Two numbers from a few hundred predictions; the slope stays positive, so that the order of confidences does.

    Args:
        confidences: In [0, 1].
        right: Whether each prediction was.
    """
    logits = logit(np.clip(confidences, _LEAST, 1 - _LEAST))
    hits = np.asarray(right, dtype=np.float64)

    def loss(parameters: np.ndarray) -> float:
        log_slope, offset = parameters
        found = np.exp(log_slope) * logits + offset
        # A little pull towards leaving all as it is, where too few predictions are right or wrong to tell.
        return float(np.mean(np.logaddexp(0, found) - hits * found) + _PULL * (log_slope**2 + offset**2))

    log_slope, offset = minimize(loss, np.zeros(2), method="Nelder-Mead").x
    return float(np.exp(log_slope)), float(offset)


def separation(with_object: Sequence[float], without: Sequence[float]) -> float:
    """AUROC: how often a frame with the object has the higher confidence than one without; ties count half.

    Raises:
        ValueError: One of the two is empty.
    """
    if len(with_object) == 0 or len(without) == 0:
        raise ValueError("separation needs frames with the object and frames without")
    ranks = rankdata([*with_object, *without])[: len(with_object)]
    return float((ranks.sum() / len(with_object) - (len(with_object) + 1) / 2) / len(without))
