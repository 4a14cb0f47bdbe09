"""Scores of pose estimates on real frames whose labels are known."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from curio_train.data.bop import Annotation, BopDataset, Frame, ModelInfo
from curio_train.evaluation.scores import add_errors, mean_of_objects, pose_scores, rotation_errors_deg
from curio_train.geometry import Pose
from curio_train.metrics.calibration import auroc, calibration_error, reliability_bins
from curio_train.metrics.poses import (
    ADD_THRESHOLD,
    bootstrap_interval,
    mspd_px,
    mssd_m,
    recall,
    symmetry_poses,
    translation_error_m,
    turned_alike,
)
from curio_train.worlds.base import ObjectKind

VISIBLE = 0.8
"""Targets of which at least this fraction is visible are scored once more, by themselves."""

_VISIBILITY_BINS = ((0.0, 0.2), (0.2, 0.4), (0.4, 0.6), (0.6, 0.8), (0.8, 1.0))
_MSSD_THRESHOLDS = [0.05 * step for step in range(1, 11)]  # of the diameter, BOP Challenge 2020
_MSPD_THRESHOLDS = [5.0 * step for step in range(1, 11)]  # pixels in an image 640 wide, BOP Challenge 2020


@dataclass(frozen=True, eq=False)
class Estimate:
    """The pose estimate of one frame."""

    frame: Frame
    """The frame."""
    pose: Pose
    """Cam_from_obj, metres."""
    confidence: float
    """1 where the model has none."""
    presence: float
    """The probability that the object is in the frame; the confidence where the model does not tell it from that."""
    seconds: float
    """Seconds spent on the frame, including decoding; the mean over frames of one batch."""


Pairs = Sequence[tuple[Estimate, Annotation]]


def scored(kind: ObjectKind, pairs: Pairs, dataset: BopDataset) -> dict[str, Any]:
    """Scores of one object's targets, all of them and each by itself."""
    points, info = dataset.evaluation_mesh(kind.name).vertices_m, kind.info
    seen = [pair for pair in pairs if (pair[1].visible_fraction or 0) >= VISIBLE]
    rows = [_row(e, target, points, info) for e, target in pairs]
    confidences, correct = _confidences(rows)
    calibration = {"confidence_ece": calibration_error(confidences, correct)}
    return {
        "num_targets": len(pairs),
        "num_targets_visible_80": len(seen),
        "metrics": _metrics(pairs, points, info) | _recall_visible(seen, points, info) | calibration,
        "by_visibility": _by_visibility(rows),
        "reliability": reliability_bins(confidences, correct),
        "targets": rows,
    }


def together(each: Mapping[str, dict[str, Any]], absent: Sequence[float]) -> dict[str, Any]:
    """Scores of several objects: means over the objects, and what all targets together say of the confidence.

    Args:
        each: Of :func:`scored`, by the object's name.
        absent: Presence of objects in frames that do not show them.
    """
    rows = [row for one in each.values() for row in one["targets"]]
    metrics = mean_of_objects([one["metrics"] for one in each.values()])
    for name, least in (("add_recall", 0.0), ("add_recall_visible_80", VISIBLE)):
        if f"{name}_low" in metrics:
            seen = [[row for row in one["targets"] if (row["visible_fraction"] or 0) >= least] for one in each.values()]
            found = (_confidences(rows)[1] for rows in seen)
            metrics[f"{name}_low"], metrics[f"{name}_high"] = bootstrap_interval(*found)
    confidences, correct = _confidences(rows)
    metrics["confidence_ece"] = calibration_error(confidences, correct)
    if absent:
        metrics["present_auroc"] = auroc([row["presence"] for row in rows], absent)
    return {
        "num_targets": len(rows),
        "num_targets_visible_80": sum(one["num_targets_visible_80"] for one in each.values()),
        "metrics": metrics,
        "by_visibility": _by_visibility(rows),
        "reliability": reliability_bins(confidences, correct),
        "objects": dict(each),
    }


def _confidences(rows: Sequence[Mapping[str, Any]]) -> tuple[list[float], list[bool]]:
    """Confidence of each target, and whether its ADD(-S) is below a tenth of the diameter."""
    return [row["confidence"] for row in rows], [row["add_diameters"] < ADD_THRESHOLD for row in rows]


def _metrics(pairs: Pairs, points: np.ndarray, info: ModelInfo) -> dict[str, float]:
    estimates, truths = [e.pose for e, _ in pairs], [target.pose for _, target in pairs]
    scores = pose_scores(estimates, truths, points, info)
    scores.pop("add_recall")
    same = symmetry_poses(info)
    nearest = [turned_alike(truth, estimate, info) for estimate, truth in zip(estimates, truths, strict=True)]
    surface = [mssd_m(e, t, points, same) / info.diameter_m for e, t in zip(estimates, nearest, strict=True)]
    pixels = [
        mspd_px(e.pose, t, points, same, e.frame.matrix) * 640 / e.frame.width
        for (e, _), t in zip(pairs, nearest, strict=True)
    ]
    return {
        **_recall("add_recall", pairs, points, info),
        **scores,
        "mssd_recall": float(np.mean([recall(surface, threshold) for threshold in _MSSD_THRESHOLDS])),
        "mspd_recall": float(np.mean([recall(pixels, threshold) for threshold in _MSPD_THRESHOLDS])),
    }


def _recall(name: str, pairs: Pairs, points: np.ndarray, info: ModelInfo) -> dict[str, float]:
    """Fraction of poses found, with its interval under the same name."""
    errors = add_errors([e.pose for e, _ in pairs], [target.pose for _, target in pairs], points, info)
    low, high = bootstrap_interval([float(error < ADD_THRESHOLD) for error in errors])
    return {name: recall(errors, ADD_THRESHOLD), f"{name}_low": low, f"{name}_high": high}


def _recall_visible(seen: Pairs, points: np.ndarray, info: ModelInfo) -> dict[str, float]:
    return _recall("add_recall_visible_80", seen, points, info) if seen else {}


def _row(estimate: Estimate, target: Annotation, points: np.ndarray, info: ModelInfo) -> dict[str, Any]:
    """The scores of one target; ADD(-S) as a fraction of the diameter."""
    found, true = [estimate.pose], [target.pose]
    return {
        "scene_id": target.scene_id,
        "image_id": target.image_id,
        "visible_fraction": target.visible_fraction,
        "confidence": round(estimate.confidence, 4),
        "presence": round(estimate.presence, 4),
        "add_diameters": round(add_errors(found, true, points, info)[0], 4),
        "rotation_deg": round(float(rotation_errors_deg(found, true, info)[0]), 2),
        "translation_mm": round(translation_error_m(estimate.pose, target.pose) * 1000, 2),
    }


def _by_visibility(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, float]]:
    """ADD(-S) recall in bins of the visible fraction; empty where the data set doesn't say it."""
    found = []
    for low, high in _VISIBILITY_BINS:
        errors = [
            row["add_diameters"]
            for row in rows
            if row["visible_fraction"] is not None
            and (low <= row["visible_fraction"] < high or row["visible_fraction"] == high == 1)
        ]
        if errors:
            right = recall(errors, ADD_THRESHOLD)
            found.append({"from": low, "to": high, "num_targets": len(errors), "add_recall": right})
    return found
