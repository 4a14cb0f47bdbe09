"""How scene codes of meshes describe rotations world_from_obj: not at all, as a yaw, or freely."""

from abc import ABC, abstractmethod

import torch
from jaxtyping import Float, Int
from torch import Tensor

from curio_train.geometry import matrix_from_rotation_6d, matrix_from_yaw, rotation_6d_from_matrix
from curio_train.scene_code import ROTATION_6D, TRANSLATION, YAW, Field, SceneCode
from curio_train.worlds.generated.fields import ROTATION_FIELD, YAW_FIELD


class Orientation(ABC):
    """A description of rotations in scene codes."""

    field: Field | None
    """Its field of the scene code, if it has one."""

    @abstractmethod
    def rotation(self, code: SceneCode) -> Float[Tensor, "batch slots 3 3"]:
        """world_from_obj of each object."""

    @abstractmethod
    def entries(self, rotation: Float[Tensor, "batch slots 3 3"]) -> dict[str, Tensor]:
        """The entries of the scene code for rotations world_from_obj."""


class NoRotation(Orientation):
    """Objects that look alike however they are turned: the identity."""

    field = None

    def rotation(self, code: SceneCode) -> Float[Tensor, "batch slots 3 3"]:
        """The identity for each object."""
        position = code[TRANSLATION].float()
        return torch.eye(3).to(position).expand(*position.shape[:2], 3, 3)

    def entries(self, rotation: Float[Tensor, "batch slots 3 3"]) -> dict[str, Tensor]:
        """No entries: there is no rotation."""
        return {}


class Yaw(Orientation):
    """Upright objects, rotated about the vertical axis y."""

    field = YAW_FIELD

    def rotation(self, code: SceneCode) -> Float[Tensor, "batch slots 3 3"]:
        """Rotation about y by the angle of (i, j)."""
        return matrix_from_yaw(code[YAW].float())

    def entries(self, rotation: Float[Tensor, "batch slots 3 3"]) -> dict[str, Tensor]:
        """(i, j) of length 1."""
        return {YAW: torch.stack([rotation[..., 0, 0], rotation[..., 0, 2]], dim=-1)}


class FoldedYaw(Orientation):
    """Upright objects with rotational symmetry: (i, j) is n times the angle of an object with n-fold symmetry.

    So codes are equal if and only if images are. Objects of revolution (n = 0) are not rotated.
    """

    field = YAW_FIELD

    def __init__(self, folds: Int[Tensor, " slots"]) -> None:
        self.folds = folds
        self._fraction = torch.where(folds > 0, 1 / folds.clamp(min=1), 0.0)

    def rotation(self, code: SceneCode) -> Float[Tensor, "batch slots 3 3"]:
        """Rotation about y by the n-th part of the angle of (i, j)."""
        folded = matrix_from_yaw(code[YAW].float())
        angle = _angle(folded) * self._fraction.to(folded)
        return matrix_from_yaw(torch.stack([angle.cos(), angle.sin()], dim=-1))

    def entries(self, rotation: Float[Tensor, "batch slots 3 3"]) -> dict[str, Tensor]:
        """(i, j) of length 1."""
        angle = _angle(rotation) * self.folds.to(rotation)
        return {YAW: torch.stack([angle.cos(), angle.sin()], dim=-1)}


class FreeRotation(Orientation):
    """Objects in any rotation."""

    field = ROTATION_FIELD

    def rotation(self, code: SceneCode) -> Float[Tensor, "batch slots 3 3"]:
        """Rotation matrix of the 6D rotation."""
        return matrix_from_rotation_6d(code[ROTATION_6D].float())

    def entries(self, rotation: Float[Tensor, "batch slots 3 3"]) -> dict[str, Tensor]:
        """The 6D rotation."""
        return {ROTATION_6D: rotation_6d_from_matrix(rotation)}


def _angle(rotation: Tensor) -> Tensor:
    """Angles of rotations about y, radians."""
    return torch.atan2(rotation[..., 0, 2], rotation[..., 0, 0])
