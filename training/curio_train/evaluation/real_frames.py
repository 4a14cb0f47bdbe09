"""Score pose estimates on the real frames of a BOP data set: whole frames in, nothing but RGB and K.

Serving's own code warps the frames to the canonical camera (:mod:`curio_serve.imaging.view`), so that scores are those
of the poses that are served. Labels are used for scoring alone.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from curio_serve.errors import CameraError
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.view import CanonicalCamera, PinholeCrop, PinholeFrame

from curio_train.data.bop import Annotation, BopDataset, Frame, ModelInfo
from curio_train.data.bop_split import SPLIT, scored_frames
from curio_train.data.photographs import read_photograph
from curio_train.errors import DataError, UsageError
from curio_train.evaluation.scores import add_errors, pose_scores, rotation_errors_deg
from curio_train.evaluation.subject import Subject
from curio_train.geometry import Pose
from curio_train.metrics.calibration import reliability_bins
from curio_train.metrics.poses import (
    ADD_THRESHOLD,
    bootstrap_interval,
    mspd_px,
    mssd_m,
    recall,
    symmetry_poses,
    translation_error_m,
)
from curio_train.scene_code import CONFIDENCE, poses
from curio_train.worlds.base import Camera

VISIBLE = 0.8
"""Targets of which at least this fraction is visible are scored once more, by themselves."""

_BATCH = 16
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
    seconds: float
    """Spent on the frame, reading included; mean of those read together."""


Pairs = Sequence[tuple[Estimate, Annotation]]


def evaluate_real_frames(subject: Subject, data: Path, bop_results: Path | None, suffix: str = "") -> dict[str, Any]:
    """Score on the targets of the object in a data set.

    Args:
        subject: Reads poses of one object.
        data: In BOP's layout.
        bop_results: Folder for a results file in BOP's format, or None.
        suffix: Of the method's name in that file's.

    Raises:
        UsageError: The world has no camera, or the data set does not know the object.
        DataError: The data set is incomplete or has no frame of it.
    """
    dataset = BopDataset(data)
    kind = subject.world.objects[0]
    frames = scored_frames(dataset, kind.name)
    estimates = estimate_frames(subject, dataset, frames.targets)
    if bop_results is not None:
        _write_bop(
            bop_results, subject.config.method + suffix, data.resolve().name, dataset.object_id(kind.name), estimates
        )
    pairs = list(zip(estimates, frames.targets, strict=True))
    points = dataset.evaluation_mesh(kind.name).vertices_m
    info = kind.info
    seen = [pair for pair in pairs if (pair[1].visible_fraction or 0) >= VISIBLE]
    rows = [_row(e, target, points, info) for e, target in pairs]
    correct = [row["add_diameters"] < ADD_THRESHOLD for row in rows]
    return {
        "dataset": data.resolve().name,
        "split": SPLIT,
        "split_name": frames.split_name,
        "num_targets": len(pairs),
        "num_targets_visible_80": len(seen),
        "metrics": _metrics(pairs, points, info) | _recall_visible(seen, points, info),
        "by_visibility": _by_visibility(pairs, points, info),
        "reliability": reliability_bins([estimate.confidence for estimate, _ in pairs], correct),
        "targets": rows,
    }


def estimate_frames(subject: Subject, dataset: BopDataset, targets: Sequence[Annotation]) -> list[Estimate]:
    """One estimate for the frame of each target, in their order.

    Raises:
        DataError: A frame is missing or cannot be read.
    """
    wanted = {(target.scene_id, target.image_id) for target in targets}
    frames = [
        frame
        for scene_id in sorted({scene for scene, _ in wanted})
        for frame in dataset.frames(SPLIT, scene_id)
        if (frame.scene_id, frame.image_id) in wanted
    ]
    batches = (frames[start : start + _BATCH] for start in range(0, len(frames), _BATCH))
    found = {(e.frame.scene_id, e.frame.image_id): e for batch in batches for e in _estimates(subject, batch)}
    if missing := wanted - found.keys():
        scene, image = min(missing)
        raise DataError(
            f"{dataset.root / SPLIT}: {len(missing)} labelled images are missing, the first is image {image} of scene "
            f"{scene}; download the split again"
        )
    return [found[target.scene_id, target.image_id] for target in targets]


def _estimates(subject: Subject, frames: Sequence[Frame]) -> Iterator[Estimate]:
    start = time.perf_counter()
    crops = [_whole_frame(frame, subject.world.camera) for frame in frames]
    images = torch.from_numpy(np.stack([crop.image for crop in crops])).permute(0, 3, 1, 2).contiguous()
    code = subject.predict(images)
    seconds = (time.perf_counter() - start) / len(frames)
    for number, (frame, crop, seen) in enumerate(zip(frames, crops, poses(code), strict=True)):
        cam_from_canonical = Pose(crop.canonical_from_cam.T, np.zeros(3))
        confidence = float(code[CONFIDENCE][number, 0]) if CONFIDENCE in code else 1.0
        yield Estimate(frame, cam_from_canonical @ seen, confidence, seconds)


def _whole_frame(frame: Frame, camera: Camera) -> PinholeCrop:
    """A frame as the canonical camera sees it.

    Raises:
        UsageError: The world has no camera.
        DataError: The frame cannot be read, or K cannot be its camera's.
    """
    if camera.matrix is None:
        raise UsageError("--data: this world is flat; expected one with a camera, to warp real frames to")
    canonical = CanonicalCamera(camera.width, camera.height, camera.matrix)
    try:
        return PinholeFrame(read_photograph(frame.path), PinholeCamera(frame.matrix), canonical).crop()
    except CameraError as exc:
        raise DataError(f"{frame.path}: {exc}") from exc


def _metrics(pairs: Pairs, points: np.ndarray, info: ModelInfo) -> dict[str, float]:
    estimates, truths = [e.pose for e, _ in pairs], [target.pose for _, target in pairs]
    scores = pose_scores(estimates, truths, points, info)
    scores.pop("add_recall")
    alike = symmetry_poses(info)
    surface = [mssd_m(e, t, points, alike) / info.diameter_m for e, t in zip(estimates, truths, strict=True)]
    pixels = [mspd_px(e.pose, target.pose, points, alike, e.frame.matrix) * 640 / e.frame.width for e, target in pairs]
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
        "add_diameters": round(add_errors(found, true, points, info)[0], 4),
        "rotation_deg": round(float(rotation_errors_deg(found, true, info)[0]), 2),
        "translation_mm": round(translation_error_m(estimate.pose, target.pose) * 1000, 2),
    }


def _by_visibility(pairs: Pairs, points: np.ndarray, info: ModelInfo) -> list[dict[str, float]]:
    """ADD(-S) recall in bins of the visible fraction; empty where the data set doesn't say it."""
    rows = []
    for low, high in _VISIBILITY_BINS:
        inside = [
            (e.pose, target.pose)
            for e, target in pairs
            if target.visible_fraction is not None
            and (low <= target.visible_fraction < high or target.visible_fraction == high == 1)
        ]
        if inside:
            estimates, truths = zip(*inside, strict=True)
            errors = add_errors(estimates, truths, points, info)
            found = recall(errors, ADD_THRESHOLD)
            rows.append({"from": low, "to": high, "num_targets": len(inside), "add_recall": found})
    return rows


def _write_bop(folder: Path, method: str, dataset: str, object_id: int, estimates: Sequence[Estimate]) -> None:
    """METHOD_DATASET-SPLIT.csv: rotations row by row, millimetres, seconds an image."""
    lines = ["scene_id,im_id,obj_id,score,R,t,time"]
    for e in estimates:
        rotation = " ".join(f"{value:.9g}" for value in e.pose.rotation.ravel())
        translation = " ".join(f"{value * 1000:.9g}" for value in e.pose.translation_m)
        frame = f"{e.frame.scene_id},{e.frame.image_id},{object_id}"
        lines.append(f"{frame},{e.confidence:.6g},{rotation},{translation},{e.seconds:.4f}")
    path = folder / f"{method.replace('_', '-')}_{dataset}-{SPLIT}.csv"  # the first underscore ends the method's name
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as exc:
        raise UsageError(f"--bop-results: cannot write {path}: {exc.strerror}") from exc
