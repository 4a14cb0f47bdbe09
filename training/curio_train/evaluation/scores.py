"""Metrics of predicted scene codes against true ones, each under a name that carries its unit."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.data.bop import ModelInfo
from curio_train.geometry import Pose, matrix_from_rotation_6d, rotation_angle_deg
from curio_train.metrics.assignment import assign, parameter_errors, scene_error
from curio_train.metrics.images import dssim
from curio_train.metrics.poses import ADD_THRESHOLD, add_or_add_s_m, recall, symmetry_poses
from curio_train.scene_code import ROTATION_6D, TRANSLATION, SceneCode, index
from curio_train.worlds.base import ObjectKind, World

_MM = 1000.0
_BATCH_SIZE = 50


def scene_scores(world: World, predicted: SceneCode, true: SceneCode) -> dict[str, float]:
    """Errors of scene codes, means over images unless the name says otherwise.

    ``scene_error`` is Eq. 1 of the paper, the table's Para, and ``novel_view_dssim`` is its Img; the others are errors
    of single parameters under the same assignment. Where slots carry a shape that assignment is within the shape, and
    ``scene_error_any_shape`` is Eq. 1 by position alone.
    """
    groups = [kind.slots for kind in world.objects]
    pairs = assign(world.layout, predicted, true, groups)
    difference = predicted[TRANSLATION][pairs.image, pairs.predicted] - true[TRANSLATION][pairs.image, pairs.true]
    distance = difference.norm(dim=-1)
    scores = {"scene_error": float(scene_error(world.layout, predicted, true, groups).mean())}
    if len(groups) > 1:
        scores["scene_error_any_shape"] = float(scene_error(world.layout, predicted, true).mean())
    scores["novel_view_dssim"] = float(novel_view_dssim(world, predicted, true).mean())
    if world.layout[TRANSLATION].unit == "image_width":
        scores["position_image_widths"] = float(distance.mean())
        scores["position_px"] = float(distance.mean()) * world.camera.width
        scores["position_px_median"] = float(distance.median()) * world.camera.width
    else:
        scores["position_mm"] = float(distance.mean()) * _MM
    others = parameter_errors(world.layout, predicted, true, groups)
    return scores | {name: value for name, value in others.items() if name != "position"}


@torch.no_grad()
def novel_view_dssim(world: World, predicted: SceneCode, true: SceneCode) -> Float[Tensor, " batch"]:
    """The paper's image error: both scenes seen from a view that the network has not, compared by DSSIM."""
    starts = range(0, len(true[TRANSLATION]), _BATCH_SIZE)
    batches = [[index(code, slice(start, start + _BATCH_SIZE)) for code in (predicted, true)] for start in starts]
    return torch.cat([dssim(*(world.novel_view(code).clamp(0, 1) for code in pair)) for pair in batches])


def poses(code: SceneCode) -> list[Pose]:
    """The poses of the one object of each image."""
    rotations = matrix_from_rotation_6d(code[ROTATION_6D][:, 0].double()).numpy()
    translations = code[TRANSLATION][:, 0].double().numpy()
    return [Pose(rotation, translation) for rotation, translation in zip(rotations, translations, strict=True)]


def model_info(kind: ObjectKind) -> ModelInfo:
    """What pose metrics need of a kind of object."""
    return ModelInfo(kind.diameter_m, tuple(kind.symmetries), tuple(kind.symmetry_axes))


def add_errors(estimates: Sequence[Pose], truths: Sequence[Pose], points: np.ndarray, info: ModelInfo) -> list[float]:
    """ADD, or ADD-S of symmetric objects, as shares of the diameter."""
    pairs = zip(estimates, truths, strict=True)
    return [add_or_add_s_m(estimate, truth, points, info) / info.diameter_m for estimate, truth in pairs]


def rotation_errors_deg(estimates: Sequence[Pose], truths: Sequence[Pose], info: ModelInfo) -> np.ndarray:
    """Angle [num_poses] between each estimate and the closest of the true poses that look alike."""
    alike = torch.from_numpy(np.stack([pose.rotation for pose in symmetry_poses(info)]))
    found, true = (torch.from_numpy(np.stack([pose.rotation for pose in side])) for side in (estimates, truths))
    return rotation_angle_deg(found[:, None], true[:, None] @ alike).amin(dim=1).numpy()


def pose_scores(
    estimates: Sequence[Pose], truths: Sequence[Pose], points: np.ndarray, info: ModelInfo
) -> dict[str, float]:
    """Share of poses found, with rotation and position errors beside.

    Of symmetric objects the rotation error is to the closest of the poses that look alike.

    Args:
        estimates: One an image.
        truths: As many.
        points: [num_points, 3] of the model, metres.
        info: Diameter and symmetries.
    """
    turns = rotation_errors_deg(estimates, truths, info)
    offsets = np.array([e.translation_m - t.translation_m for e, t in zip(estimates, truths, strict=True)]) * _MM
    return {
        "add_recall": recall(add_errors(estimates, truths, points, info), ADD_THRESHOLD),
        "rotation_deg_median": float(np.median(turns)),
        "translation_mm_median": float(np.median(np.linalg.norm(offsets, axis=1))),
        "lateral_mm_median": float(np.median(np.linalg.norm(offsets[:, :2], axis=1))),
        "depth_mm_median": float(np.median(np.abs(offsets[:, 2]))),
    }
