"""Rotations that look alike: of symmetric objects, the true rotation is the one nearest to the predicted rotation."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.data.bop import ModelInfo
from curio_train.geometry import matrix_from_rotation_6d, rotation_6d_from_matrix, rotation_angle_deg


def nearest_symmetric(
    predicted_6d: Float[Tensor, "batch slots 6"],
    true_6d: Float[Tensor, "batch slots 6"],
    slot_infos: Sequence[ModelInfo],
) -> Float[Tensor, "batch slots 6"]:
    """The rotations nearest to the predicted ones, of those that look like the true ones; without gradient.

    Args:
        predicted_6d: Rotations from the object frame, of any length.
        true_6d: The true ones.
        slot_infos: Symmetries of each slot's object, in the frame that the rotations are from. Objects without any
            keep their true rotations; of objects that turn any way the predicted rotation is the nearest.
    """
    nearest = true_6d.clone()
    for slot, info in enumerate(slot_infos):
        if info.is_symmetric:
            predicted, true = (
                matrix_from_rotation_6d(code[:, slot].detach().double()) for code in (predicted_6d, true_6d)
            )
            nearest[:, slot] = rotation_6d_from_matrix(_nearest(predicted, true, info)).to(true_6d)
    return nearest


def _nearest(
    predicted: Float[Tensor, "batch 3 3"], true: Float[Tensor, "batch 3 3"], info: ModelInfo
) -> Float[Tensor, "batch 3 3"]:
    if info.turns_any_way:
        return predicted
    symmetries = torch.from_numpy(np.stack([np.eye(3), *(matrix[:3, :3] for matrix in info.symmetries)])).to(true)
    if info.symmetry_axes:
        between = true.transpose(-1, -2)[:, None] @ predicted[:, None] @ symmetries.transpose(-1, -2)
        symmetries = _nearest_turns(between, torch.from_numpy(info.symmetry_axes[0][0]).to(true)) @ symmetries
    alike = true[:, None] @ symmetries
    best = rotation_angle_deg(predicted[:, None], alike).argmin(dim=1)
    return alike[torch.arange(len(best), device=best.device), best]


def _nearest_turns(rotation: Float[Tensor, "*batch 3 3"], axis: Float[Tensor, "3"]) -> Float[Tensor, "*batch 3 3"]:
    """The turns about an axis that are nearest to given rotations: they have the largest trace of turnᵀ rotation."""
    unit = axis / axis.norm()
    along = torch.outer(unit, unit)
    level = torch.eye(3).to(unit) - along
    skew = torch.linalg.cross(unit.expand(3, 3), torch.eye(3).to(unit)).T
    angle = torch.atan2((skew * rotation).sum(dim=(-2, -1)), (level * rotation).sum(dim=(-2, -1)))[..., None, None]
    return along + angle.cos() * level + angle.sin() * skew
