"""Errors of a scene code: Eq. 1 of the paper, and parameter by parameter, under one assignment of objects.

Eq. 1 leaves its weights and unequal numbers of objects open. As read here: every field is divided by its range, then
w = 1; objects are paired by the least sum of distances in position alone; a prediction without an object costs its
squared confidence, an object without a prediction costs 1. Every slot is a prediction, however low its confidence.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from curio_train.data.bop import ModelInfo
from curio_train.geometry import (
    direction_from_hemisphere,
    matrix_from_rotation_6d,
    matrix_from_yaw,
    rotation_6d_from_matrix,
    rotation_angle_deg,
)
from curio_train.metrics.symmetric_rotations import nearest_symmetric
from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION, YAW, Layout, SceneCode

Groups = Sequence[Sequence[int]]


@dataclass(frozen=True, eq=False)
class Assignment:
    """Pairs of predictions and objects.

    The pairs of all images are in one list, so that ``code[field][image, slot]`` are the paired values.
    """

    image: Int[Tensor, " pairs"]
    """Position in the batch of each pair."""
    predicted: Int[Tensor, " pairs"]
    """Slot of the prediction of each pair."""
    true: Int[Tensor, " pairs"]
    """Slot of the object of each pair."""
    surplus: Bool[Tensor, "batch num_predicted"]
    """Predictions without an object."""
    missing: Bool[Tensor, "batch num_true"]
    """Objects without a prediction."""


def assign(layout: Layout, predicted: SceneCode, true: SceneCode, groups: Groups | None = None) -> Assignment:
    """Pair predictions and objects of each image by the least sum of distances (Eq. 1, second line).

    Args:
        layout: Of both codes. Their numbers of slots may differ.
        predicted: ``translation_m`` [batch, num_predicted, 3].
        true: ``translation_m`` [batch, num_true, 3]; an object is there if its confidence is above a half, or the
            layout has no confidence.
        groups: Slots of one shape each, which may be exchanged for each other; default: all slots are alike.
    """
    found, objects = predicted[TRANSLATION].detach(), true[TRANSLATION].detach()
    present = torch.ones(objects.shape[:2], dtype=torch.bool, device=objects.device)
    if CONFIDENCE in layout:
        present = true[CONFIDENCE][..., 0] > 0.5
    surplus = torch.ones(found.shape[:2], dtype=torch.bool, device=found.device)
    missing = present.clone()
    pairs: list[tuple[int, int, int]] = []
    distances, there = torch.cdist(found, objects).cpu().numpy(), present.cpu().numpy()
    for members in groups or [range(max(found.shape[1], objects.shape[1]))]:
        rows = [slot for slot in members if slot < found.shape[1]]
        for image, distance in enumerate(distances):
            columns = [slot for slot in members if slot < objects.shape[1] and there[image, slot]]
            chosen = linear_sum_assignment(distance[rows][:, columns])
            pairs += [(image, rows[i], columns[j]) for i, j in zip(*chosen, strict=True)]
    images, slots, object_slots = torch.tensor(pairs, dtype=torch.long, device=found.device).reshape(-1, 3).unbind(-1)
    surplus[images, slots] = False
    missing[images, object_slots] = False
    return Assignment(images, slots, object_slots, surplus, missing)


def nearest_alike(
    layout: Layout,
    predicted: SceneCode,
    true: SceneCode,
    slot_infos: Sequence[ModelInfo],
    groups: Groups | None = None,
) -> dict[str, Tensor]:
    """The true code with the rotation of each paired object replaced by the nearest to its prediction that looks alike.

    Args:
        layout: Of both codes.
        predicted: As in :func:`assign`.
        true: As in :func:`assign`.
        slot_infos: Symmetries of each slot's object, in the frame that rotations in the codes are from.
        groups: As in :func:`assign`.
    """
    if ROTATION_6D not in layout or not any(info.is_symmetric for info in slot_infos):
        return dict(true)
    pairs = assign(layout, predicted, true, groups)
    found = true[ROTATION_6D].clone()
    found[pairs.image, pairs.true] = predicted[ROTATION_6D].detach()[pairs.image, pairs.predicted]
    return {**true, ROTATION_6D: nearest_symmetric(found, true[ROTATION_6D], slot_infos)}


def scene_error(
    layout: Layout,
    predicted: SceneCode,
    true: SceneCode,
    groups: Groups | None = None,
) -> Float[Tensor, " batch"]:
    """Eq. 1 for each image, differentiable in the prediction; 0 where both scenes are the same.

    Args:
        layout: Of both codes.
        predicted: The code to judge. Rotations count as rotations: the length of (i, j) or of a 6D rotation does not.
        true: The scene's own.
        groups: As in :func:`assign`.
    """
    pairs = assign(layout, predicted, true, groups)
    a, b = canonical(predicted), canonical(true)
    error = pairs.missing.sum(dim=1).to(a[TRANSLATION].dtype)
    error = error + (_confidence(layout, a).square() * pairs.surplus).sum(dim=1)
    for field in layout.fields:
        of_a, of_b = (field.relative(code[field.name]) for code in (a, b))
        if field.per_object:
            distance = (of_a[pairs.image, pairs.predicted] - of_b[pairs.image, pairs.true]).norm(dim=-1)
            error = error.index_add(0, pairs.image, distance)
        else:
            error = error + (of_a - of_b).norm(dim=-1)
    return error


def parameter_errors(
    layout: Layout, predicted: SceneCode, true: SceneCode, groups: Groups | None = None
) -> dict[str, float]:
    """Means of :func:`each_parameter_error` over a test set; NaN without a single pair."""
    errors = each_parameter_error(layout, predicted, true, groups)
    return {name: float(values.double().mean()) for name, values in errors.items()}


def each_parameter_error(
    layout: Layout,
    predicted: SceneCode,
    true: SceneCode,
    groups: Groups | None = None,
    yaw_folds: Int[Tensor, " slots"] | None = None,
) -> dict[str, Tensor]:
    """Errors of each kind of parameter, for those the layout has; one value a pair unless said otherwise.

    Args:
        layout: Of both codes.
        predicted: As in :func:`assign`.
        true: As in :func:`assign`.
        groups: As in :func:`assign`.
        yaw_folds: By what the angle of each slot's object is multiplied to give the yaw in the codes, 0 if its angle
            cannot be seen; None: by 1.

    Returns:
        ``position``: distance, metres (image widths in 2D worlds). ``color_mse``: squared difference, a value a channel
        [pairs, 3]. ``rotation_deg``: angle between the objects' rotations. ``confidence_mse``: squared difference from
        1 of paired predictions and from 0 of the others, [batch, num_predicted]. ``light_deg``: angle of the light
        directions, [batch].
    """
    pairs = assign(layout, predicted, true, groups)

    def paired(name: str) -> tuple[Tensor, Tensor]:
        return predicted[name][pairs.image, pairs.predicted], true[name][pairs.image, pairs.true]

    found, objects = paired(TRANSLATION)
    errors = {"position": (found - objects).norm(dim=-1)}
    if COLOR in layout:
        found, objects = paired(COLOR)
        errors["color_mse"] = (found - objects).square()
    for name, matrix in ((YAW, matrix_from_yaw), (ROTATION_6D, matrix_from_rotation_6d)):
        if name in layout:
            found, objects = paired(name)
            errors["rotation_deg"] = rotation_angle_deg(matrix(found), matrix(objects))
    if YAW in layout and yaw_folds is not None:
        fold = yaw_folds.to(pairs.true)[pairs.true]
        errors["rotation_deg"] = torch.where(fold > 0, errors["rotation_deg"] / fold.clamp(min=1), 0.0)
    if CONFIDENCE in layout:
        errors["confidence_mse"] = (predicted[CONFIDENCE][..., 0] - (~pairs.surplus).float()).square()
    if LIGHT in layout:
        errors["light_deg"] = _angle_deg(_direction(predicted[LIGHT]), _direction(true[LIGHT]))
    return errors


def canonical(code: SceneCode) -> dict[str, Tensor]:
    """A scene with yaws of length 1 and 6D rotations orthonormal, so that equal rotations are equal numbers."""
    same = dict(code)
    if YAW in code:
        matrix = matrix_from_yaw(code[YAW])
        same[YAW] = torch.stack([matrix[..., 0, 0], matrix[..., 0, 2]], dim=-1)
    if ROTATION_6D in code:
        same[ROTATION_6D] = rotation_6d_from_matrix(matrix_from_rotation_6d(code[ROTATION_6D]))
    return same


def _confidence(layout: Layout, code: SceneCode) -> Tensor:
    """[batch, num_slots]; worlds without the field are certain of every object."""
    return code[CONFIDENCE][..., 0] if CONFIDENCE in layout else torch.ones_like(code[TRANSLATION][..., 0])


def _direction(light: Tensor) -> Tensor:
    """[batch, 3] of either form of light: two numbers on the hemisphere, or a vector."""
    return direction_from_hemisphere(light) if light.shape[-1] == 2 else light


def _angle_deg(a: Tensor, b: Tensor) -> Tensor:
    return torch.rad2deg(torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(dim=-1)))
