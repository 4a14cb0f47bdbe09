"""Multi-view consensus: poses in a static scene on which photographs by a moving camera agree.

A single photograph is misinterpreted as often as not, but each in its own way: a can whose spout points at the camera
is taken for one that is rotated away, and half of all errors are in depth. Given the camera's motion (structure from
motion), every prediction becomes a pose in the scene, and predictions of several photographs that agree there are right
together (after Labbé et al. 2020, "CosyPose", section 3.2). Each consensus pose is then verified in all photographs.
Objects may be moved between photographs; each position has a pose of its own.

No label is used: the scale of the scene, which structure from motion leaves open, is estimated from the predictions.
The predictions of one object err in depth all to one side, by some per cent, and so does its scale; several objects of
one scene err independently (decision 68). Therefore camera poses may also be given in metres.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from curio_serve.consensus.poses import Consensus, Predictions, angles_deg, consensus, position_covariance_m2
from jaxtyping import Bool, Int
from torch import Tensor

from curio_train.data.bop import ModelInfo
from curio_train.data.photographs import CameraPoses
from curio_train.geometry import Pose, matrix_from_rotation_6d, rotation_6d_from_matrix
from curio_train.metrics.poses import symmetry_poses
from curio_train.refinement.render_and_compare import MIN_INLIER_RATIO, RenderAndCompare
from curio_train.scene_code import ROTATION_6D, TRANSLATION, SceneCode, index
from curio_train.worlds.single_object.crop_pose_loss import SYMMETRY_STEP

_MIN_PHOTOGRAPHS = 3  # in a consensus
_MIN_PREDICTIONS = 4  # in a consensus; a photograph has up to two, predicted and refined
_MAX_ANGLE_DEG = 20.0
_ACROSS, _IN_DEPTH = 0.04, 0.04  # standard deviations of positions: diameters across the view, relative in depth
_MOVED = 0.03  # standard deviation of movements in the scene, diameters
_MIN_PAIRS = 30  # of predictions, for a scale
_MAX_GAP, _MIN_BASELINE = 0.6, 0.5  # diameters, of such pairs
_SAME_SCALE = 0.05  # difference of logarithms within which scales support each other
_CREDIBLE, _TOLERANCE = 0.3, 0.1  # inlier ratios of a photograph's own prediction
_CONTRADICTION = 0.25  # diameters across the view


@dataclass(frozen=True, eq=False)
class Estimates:
    """Poses of one object in photographs."""

    predicted: SceneCode
    """Poses that the network predicted."""
    refined: SceneCode
    """These poses after render-and-compare."""
    accepted: Bool[Tensor, " num"]
    """Whether render-and-compare accepted its result."""


class _Predictions(NamedTuple):
    """Some predictions, one a row."""

    frame: Int[np.ndarray, " n"]
    """Number of the photograph."""
    cam_from_obj: Pose[np.ndarray]
    """[n, …]."""


class _StaticScene(NamedTuple):
    """Cameras in a static scene."""

    cam_from_world: Pose[np.ndarray]
    """[num, …], metres."""
    known: Bool[np.ndarray, " num"]
    """Photographs whose camera pose is known."""


def consensus_poses(
    refiner: RenderAndCompare,
    frames: Tensor,
    cameras: CameraPoses,
    estimates: Estimates,
    info: ModelInfo,
) -> tuple[dict[str, Tensor], Bool[Tensor, " num"]]:
    """Poses on which photographs agree.

    Args:
        refiner: Of the object; measures inlier ratios.
        frames: uint8 sRGB [num, 3, height, width].
        cameras: Their camera poses.
        estimates: The poses in each.
        info: Diameter and symmetries of the object.

    Returns:
        The predicted code with consensus positions and rotations, and which photographs show the object so.
    """
    known, accepted = cameras.known, estimates.accepted
    sources = _predictions(estimates.predicted, known), _predictions(estimates.refined, known & accepted.numpy())
    scales = [
        estimate_scale(cameras, code, accepted, info.diameter_m) for code in (estimates.predicted, estimates.refined)
    ]
    found = [scale for scale in scales if scale is not None]
    if not found:
        return dict(estimates.predicted), torch.zeros(len(frames), dtype=torch.bool)
    scale = 1.0 if cameras.in_metres else float(np.exp(np.mean(np.log(found))))
    # Predicted and refined poses each have their own error in depth, which their scale shows.
    corrected = [
        (frame, pose.rotation, pose.translation_m * scale / own)
        for (frame, pose), own in zip(sources, scales, strict=True)
        if own is not None
    ]
    frame, rotation, translation_m = (np.concatenate(values) for values in zip(*corrected, strict=True))
    cam_from_world = _known_or_identity(cameras)
    scene = _StaticScene(Pose(cam_from_world.rotation, scale * cam_from_world.translation_m), known)
    predictions = _Predictions(frame, Pose(rotation, translation_m))
    agreed = consensus_in_scene(scene.cam_from_world, predictions.frame, predictions.cam_from_obj, info)
    poses = [Pose(one.rotation, one.translation_m) for one in agreed]
    return _verified(refiner, frames, scene, poses, estimates, info)


def estimate_scale(
    cameras: CameraPoses, code: SceneCode, accepted: Bool[Tensor, " num"], diameter_m: float
) -> float | None:
    """Metres a unit of the scene, from how far a predicted object moved relative to the camera.

    Args:
        cameras: Camera poses of the photographs.
        code: Predictions in them.
        accepted: Predictions that are better than others; only these are used if they are enough.
        diameter_m: Of the object.

    Returns:
        None if too few pairs of predictions agree.
    """
    cam_from_world, known = _known_or_identity(cameras), cameras.known
    scale = _scale(cam_from_world, _predictions(code, known & accepted.numpy()), diameter_m)
    return scale or _scale(cam_from_world, _predictions(code, known), diameter_m)


def _known_or_identity(cameras: CameraPoses) -> Pose[np.ndarray]:
    return Pose.from_matrix(np.where(cameras.known[:, None, None], cameras.cam_from_world, np.eye(4)))


def _predictions(code: SceneCode, chosen: Bool[np.ndarray, " num"]) -> _Predictions:
    rotation = matrix_from_rotation_6d(code[ROTATION_6D][:, 0]).double().numpy()
    translation_m = code[TRANSLATION][:, 0].double().numpy()
    return _Predictions(np.flatnonzero(chosen), Pose(rotation[chosen], translation_m[chosen]))


def _scale(cameras: Pose[np.ndarray], predictions: _Predictions, diameter_m: float) -> float | None:
    """Metres a unit of the scene: the mode over all pairs of photographs."""
    world_from_cam = cameras.rows(predictions.frame).inverse()
    centres = world_from_cam.translation_m
    rays_m = _rotated(world_from_cam.rotation, predictions.cam_from_obj.translation_m)  # in the scene's axes
    first, second = np.triu_indices(len(rays_m), 1)
    moved, difference_m = centres[first] - centres[second], rays_m[first] - rays_m[second]
    baseline = np.linalg.norm(moved, axis=1).clip(min=1e-9)
    scale = -(moved * difference_m).sum(axis=1) / baseline**2
    gap_m = np.linalg.norm(moved * scale[:, None] + difference_m, axis=1)
    fits = (scale > 0) & (gap_m < _MAX_GAP * diameter_m) & (baseline * scale > _MIN_BASELINE * diameter_m)
    logs = np.sort(np.log(scale[fits]))
    if len(logs) < _MIN_PAIRS:
        return None
    support = np.searchsorted(logs, logs + _SAME_SCALE) - np.searchsorted(logs, logs - _SAME_SCALE)
    near = np.abs(logs - logs[support.argmax()]) < _SAME_SCALE
    return float(np.exp(np.median(logs[near]))) if near.sum() >= _MIN_PAIRS else None


def _rotated(rotation: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    return np.einsum("nij,nj->ni", rotation, vectors)


def consensus_in_scene(
    cam_from_world: Pose[np.ndarray],
    frame: Int[np.ndarray, " n"],
    cam_from_obj: Pose[np.ndarray],
    info: ModelInfo,
    *,
    in_depth: float = _IN_DEPTH,
    moved: float = _MOVED,
) -> list[Consensus]:
    """Poses world_from_obj on which predictions of several photographs agree, those of most predictions first.

    Predictions of an object that turns any way need to agree on its position alone; its axes are then the scene's.

    Args:
        cam_from_world: Of the photographs, metres.
        frame: Number of the photograph that each prediction is of.
        cam_from_obj: The predictions, [n, …].
        info: Diameter and symmetries of the object.
        in_depth: Standard deviation of distances, relative.
        moved: Standard deviation of movements in the scene, diameters.
    """
    world_from_cam = cam_from_world.rows(frame).inverse()
    poses = world_from_cam @ cam_from_obj
    rotation = np.tile(np.eye(3), (len(frame), 1, 1)) if info.turns_any_way else poses.rotation
    rays_m = _rotated(world_from_cam.rotation, cam_from_obj.translation_m)
    across_m, moved_m = _ACROSS * info.diameter_m, moved * info.diameter_m
    covariance = position_covariance_m2(rays_m, across_m, in_depth) + np.eye(3) * moved_m**2
    return consensus(
        Predictions(frame, rotation, poses.translation_m, covariance),
        _symmetries(info),
        min_predictions=_MIN_PREDICTIONS,
        min_views=_MIN_PHOTOGRAPHS,
    )


def _symmetries(info: ModelInfo) -> np.ndarray:
    """Rotations [n, 3, 3] of the object onto itself."""
    return np.stack([pose.rotation for pose in symmetry_poses(info, SYMMETRY_STEP)])


def _verified(
    refiner: RenderAndCompare,
    frames: Tensor,
    scene: _StaticScene,
    poses: list[Pose[np.ndarray]],
    estimates: Estimates,
    info: ModelInfo,
) -> tuple[dict[str, Tensor], Bool[Tensor, " num"]]:
    """The consensus pose with the most inliers in each photograph, unless the photograph's own estimate contradicts it.

    If the own estimate has inliers, a consensus pose must be near its position and have nearly as many; if its rotation
    differs, more. Rotations of an object that turns any way never differ.
    """
    symmetries = _symmetries(info)
    own_ratio = refiner.inlier_ratio(frames, estimates.refined).numpy()
    own = _predictions(estimates.refined, np.ones(len(frames), dtype=bool)).cam_from_obj
    best, code = np.zeros(len(frames)), {name: value.clone() for name, value in estimates.predicted.items()}
    for pose in poses:
        cam_from_obj = scene.cam_from_world @ pose
        position_m = cam_from_obj.translation_m
        rotated = angles_deg(cam_from_obj.rotation, own.rotation, symmetries)[0] > 2 * _MAX_ANGLE_DEG
        rotated &= not info.turns_any_way
        own_at_depth = own.translation_m[:, :2] * (position_m[:, 2:] / own.translation_m[:, 2:])
        offset_m = np.linalg.norm(position_m[:, :2] - own_at_depth, axis=1)
        elsewhere = (own_ratio > _CREDIBLE) & (offset_m > _CONTRADICTION * info.diameter_m)
        required = np.maximum(MIN_INLIER_RATIO, np.where(rotated, own_ratio, own_ratio - _TOLERANCE))
        candidates = torch.from_numpy(np.flatnonzero(scene.known & refiner.in_view(position_m) & ~elsewhere))
        if len(candidates) == 0:
            continue
        posed, ratio = _with_pose(estimates.predicted, cam_from_obj), np.zeros(len(frames))
        ratio[candidates.numpy()] = refiner.inlier_ratio(frames[candidates], index(posed, candidates)).numpy()
        wins = ratio > np.maximum(best, required)
        best = np.where(wins, ratio, best)
        code = {
            name: torch.where(torch.from_numpy(wins).view(-1, *[1] * (value.dim() - 1)), posed[name], value)
            for name, value in code.items()
        }
    return code, torch.from_numpy(best > 0)


def _with_pose(code: SceneCode, cam_from_obj: Pose[np.ndarray]) -> dict[str, Tensor]:
    """The code with other poses."""
    return dict(code) | {
        TRANSLATION: torch.from_numpy(cam_from_obj.translation_m).float()[:, None],
        ROTATION_6D: rotation_6d_from_matrix(torch.from_numpy(cam_from_obj.rotation).float())[:, None],
    }
