"""Metrics of predicted scene codes against true ones, each under a name that carries its unit."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.data.bop import ModelInfo
from curio_train.geometry import Pose, rotation_angle_deg
from curio_train.metrics.assignment import each_parameter_error, nearest_alike, scene_error
from curio_train.metrics.images import dssim
from curio_train.metrics.poses import ADD_THRESHOLD, add_or_add_s_m, recall, symmetry_poses, turned_alike
from curio_train.scene_code import TRANSLATION, SceneCode, index, poses
from curio_train.worlds.base import World
from curio_train.worlds.single_object.world import SingleObjectWorld

_MM = 1000.0
_MOST_TURNED_DEG = 10.0
_BATCH_SIZE = 50


def scene_scores(
    world: World, predicted: SceneCode, true: SceneCode, errors: dict[str, Tensor] | None = None
) -> dict[str, float]:
    """Means of :func:`scene_errors` over images or pairs, and what stands beside them.

    Where slots carry a shape, ``scene_error_any_shape`` is Eq. 1 by position alone. ``errors`` are these, if they are
    known already: they take long.
    """
    errors = scene_errors(world, predicted, true) if errors is None else errors
    scores = {name: float(values.double().mean()) for name, values in errors.items()}
    if len(world.objects) > 1:
        alike = nearest_alike(world.layout, predicted, true, world.slot_infos)
        scores["scene_error_any_shape"] = float(scene_error(world.layout, predicted, alike).mean())
    if "position_image_widths" in errors:
        scores["position_px"] = scores["position_image_widths"] * world.camera.width
        scores["position_px_median"] = float(errors["position_image_widths"].median()) * world.camera.width
    return scores


def scene_errors(world: World, predicted: SceneCode, true: SceneCode) -> dict[str, Tensor]:
    """Each single error of scene codes, under a name with its unit.

    ``scene_error`` is Eq. 1 of the paper, the table's Para, and ``novel_view_dssim`` is its Img, one value an image.
    The others are errors of single parameters under the same assignment, within a shape where slots carry one. Of
    symmetric objects the true pose is the one nearest to the prediction of those that look alike.
    """
    groups = [kind.slots for kind in world.objects]
    true = nearest_alike(world.layout, predicted, true, world.slot_infos, groups)
    errors = {
        "scene_error": scene_error(world.layout, predicted, true, groups),
        "novel_view_dssim": novel_view_dssim(world, predicted, true),
    }
    parameters = each_parameter_error(world.layout, predicted, true, groups, world.yaw_folds)
    position = parameters.pop("position")
    if world.layout[TRANSLATION].unit == "image_width":
        errors["position_image_widths"] = position
    else:
        errors["position_mm"] = position * _MM
    return errors | parameters


@torch.no_grad()
def novel_view_dssim(world: World, predicted: SceneCode, true: SceneCode) -> Float[Tensor, " batch"]:
    """The paper's image error: both scenes seen from a view that the network has not, compared by DSSIM."""
    starts = range(0, len(true[TRANSLATION]), _BATCH_SIZE)
    batches = [[index(code, slice(start, start + _BATCH_SIZE)) for code in (predicted, true)] for start in starts]
    return torch.cat([dssim(*(world.novel_view(code).clamp(0, 1) for code in pair)) for pair in batches])


def mean_of_objects(each: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Means over objects of the scores that all have; the mean of medians is no median, and named apart."""
    shared = [name for name in each[0] if all(name in scores for scores in each)]
    return {
        f"{name}_mean" if name.endswith("_median") else name: float(np.mean([scores[name] for scores in each]))
        for name in shared
    }


def accuracy(world: World, predicted: SceneCode, true: SceneCode) -> float:
    """Fraction of objects that are right.

    Of one object with a mesh: ADD(-S) is below a tenth of the diameter. In other worlds: the position is off by less
    than a tenth of the smallest diameter, and the rotation, where there is one, by less than 10 degrees.
    """
    if isinstance(world, SingleObjectWorld):
        kind = world.objects[0]
        errors = add_errors(poses(predicted), poses(true), world.object.mesh.vertices_m, kind.info)
        return recall(errors, ADD_THRESHOLD)
    groups = [kind.slots for kind in world.objects]
    true = nearest_alike(world.layout, predicted, true, world.slot_infos, groups)
    found = each_parameter_error(world.layout, predicted, true, groups, world.yaw_folds)
    right = found["position"] < ADD_THRESHOLD * min(kind.diameter_m for kind in world.objects)
    if "rotation_deg" in found:
        right &= found["rotation_deg"] < _MOST_TURNED_DEG
    return float(right.float().mean())


def add_errors(estimates: Sequence[Pose], truths: Sequence[Pose], points: np.ndarray, info: ModelInfo) -> list[float]:
    """ADD, or ADD-S of symmetric objects, as fractions of the diameter."""
    pairs = zip(estimates, truths, strict=True)
    return [add_or_add_s_m(estimate, truth, points, info) / info.diameter_m for estimate, truth in pairs]


def rotation_errors_deg(estimates: Sequence[Pose], truths: Sequence[Pose], info: ModelInfo) -> np.ndarray:
    """Angle [num_poses] between each estimate and the closest of the true poses that look alike; 0 for a ball."""
    truths = [turned_alike(truth, estimate, info) for estimate, truth in zip(estimates, truths, strict=True)]
    alike = torch.from_numpy(np.stack([pose.rotation for pose in symmetry_poses(info)]))
    found, true = (torch.from_numpy(np.stack([pose.rotation for pose in side])) for side in (estimates, truths))
    return rotation_angle_deg(found[:, None], true[:, None] @ alike).amin(dim=1).numpy()


def pose_scores(
    estimates: Sequence[Pose], truths: Sequence[Pose], points: np.ndarray, info: ModelInfo
) -> dict[str, float]:
    """Fraction of poses found, with rotation and position errors beside.

    Of symmetric objects the rotation error is to the closest of the poses that look alike.

    Args:
        estimates: One an image.
        truths: As many.
        points: [num_points, 3] of the model, metres.
        info: Diameter and symmetries.
    """
    rotation_deg = rotation_errors_deg(estimates, truths, info)
    offsets = np.array([e.translation_m - t.translation_m for e, t in zip(estimates, truths, strict=True)]) * _MM
    return {
        "add_recall": recall(add_errors(estimates, truths, points, info), ADD_THRESHOLD),
        "rotation_deg_median": float(np.median(rotation_deg)),
        "translation_mm_median": float(np.median(np.linalg.norm(offsets, axis=1))),
        "lateral_mm_median": float(np.median(np.linalg.norm(offsets[:, :2], axis=1))),
        "depth_mm_median": float(np.median(np.abs(offsets[:, 2]))),
    }
