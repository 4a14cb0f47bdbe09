"""Split conformal prediction: bounds of errors that hold for new answers in a given fraction of cases.

The bound is a quantile of errors on answers that the predictor was not fitted to (Vovk et al. 2005; Lei et al. 2018,
"Distribution-free predictive inference for regression"). It holds whatever the distribution of the errors, as long as
new answers come from the same.
"""

import math
from collections.abc import Sequence

import numpy as np
from curio_proto.v1.model_spec_pb2 import PoseBounds
from jaxtyping import Float
from numpy.typing import ArrayLike

LEVEL = 0.9
"""Fraction of true poses that a bound holds."""

MOST_FALSE = 0.05
"""Largest fraction of frames without the object whose answer is sure."""

_MIN_IN_BIN, _MAX_BINS = 200, 4  # answers of one confidence: fewer would leave their quantile too uncertain


def conformal_quantile(errors: ArrayLike, level: float) -> float:
    """The error that a new one is at most, with a probability of at least ``level``.

    Args:
        errors: [n], of answers that nothing was fitted to.
        level: In (0, 1).

    Raises:
        ValueError: There are too few errors for that level.
    """
    found = np.sort(np.asarray(errors, dtype=np.float64))
    rank = math.ceil((len(found) + 1) * level)
    if rank > len(found):
        raise ValueError(f"{len(found)} errors are too few for a bound that holds for {level:.0%}")
    return float(found[rank - 1])


def sure_from(confidences_without: Sequence[float]) -> float:
    """The confidence that at most :data:`MOST_FALSE` of the answers reach on frames without the object.

    Args:
        confidences_without: On such frames.

    Raises:
        ValueError: They are too few.
    """
    # The quantile itself may be reached, as may be its equals: the next number may not.
    return float(np.nextafter(conformal_quantile(confidences_without, 1 - MOST_FALSE), np.inf))


def error_bounds(confidences: ArrayLike, errors: Float[np.ndarray, "n 3"], sure: float) -> list[PoseBounds]:
    """Bounds for sure answers, by confidence, ascending.

    Args:
        confidences: [n], on frames with the object.
        errors: Of these answers: across the line of sight in metres, along it as a fraction of the distance, and of the
            rotation in degrees.
        sure: From :func:`sure_from`.

    Raises:
        ValueError: Too few of them are sure.
    """
    found = np.asarray(confidences, dtype=np.float64)
    errors, found = errors[found >= sure], found[found >= sure]
    num_bins = min(_MAX_BINS, max(1, len(found) // _MIN_IN_BIN))
    starts = np.quantile(found, np.arange(1, num_bins) / num_bins) if num_bins > 1 else np.zeros(0)
    starts = np.unique(np.concatenate([[sure], starts]))
    bins = np.searchsorted(starts, found, side="right") - 1
    return [_bounds(float(start), errors[bins == number]) for number, start in enumerate(starts)]


def _bounds(start: float, errors: Float[np.ndarray, "n 3"]) -> PoseBounds:
    lateral, depth, rotation = (conformal_quantile(column, LEVEL) for column in errors.T)
    # Both parts of the position have to hold at once: the two bounds grow together until they do.
    units = np.maximum([lateral, depth], 1e-9)
    together = conformal_quantile((errors[:, :2] / units).max(axis=1), LEVEL)
    return PoseBounds(
        min_confidence=start,
        lateral_m=units[0] * together,
        depth_fraction=units[1] * together,
        rotation_deg=max(rotation, 1e-6),
    )
