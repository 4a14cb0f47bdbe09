"""Rotations and rigid transforms in torch, batch first.

Frames and handedness: everything is right-handed; the camera frame is OpenCV's (x right, y down, z forward), the world
frame of the ground-plane scenes has y up. A transform is a :class:`Pose`, named target_from_source; a point x of the
source frame becomes ``rotation @ x + translation_m``.

6D rotations are Zhou et al. 2019 ("On the Continuity of Rotation Representations in Neural Networks"), the first two
**columns** of the matrix, column after column. (PyTorch3D stores rows.)
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

# Shorter vectors count as without a direction. Gradients of a direction grow as 1 / length, so this also bounds them.
_SHORTEST = 1e-6

Array = TypeVar("Array", np.ndarray, Tensor)


@dataclass(frozen=True, eq=False)
class Pose(Generic[Array]):
    """A rigid transform target_from_source, or a batch of them: numpy arrays, as files and metrics have, or tensors."""

    rotation: Array
    """[*batch, 3, 3]."""
    translation_m: Array
    """[*batch, 3]: the source frame's origin in the target frame."""

    def __iter__(self) -> Iterator[Array]:
        """Rotation and translation, to unpack."""
        return iter((self.rotation, self.translation_m))

    @staticmethod
    def identity() -> "Pose[np.ndarray]":
        """The pose that moves nothing, in numpy."""
        return Pose(np.eye(3), np.zeros(3))

    @staticmethod
    def from_matrix(matrix: Array) -> "Pose[Array]":
        """The pose of homogeneous matrices [*batch, 4, 4]."""
        return Pose(matrix[..., :3, :3], matrix[..., :3, 3])

    @property
    def matrix(self) -> np.ndarray:
        """A single pose as a homogeneous matrix [4, 4], float64."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self
        return matrix

    def rows(self, which: int | slice | np.ndarray) -> "Pose[Array]":
        """Those poses of a batch; the single pose of a number."""
        return Pose(self.rotation[which], self.translation_m[which])

    def apply(self, points: Array) -> Array:
        """Points of the source frame in the target frame.

        Args:
            points: [*batch, n, 3]; leading dimensions broadcast. For a single pose any shape [..., 3].
        """
        single = self.rotation.ndim == 2
        translation_m = self.translation_m if single else self.translation_m[..., None, :]
        return points @ self.rotation.swapaxes(-1, -2) + translation_m

    def inverse(self) -> "Pose[Array]":
        """source_from_target."""
        transposed = self.rotation.swapaxes(-1, -2)
        return Pose(transposed, -(transposed @ self.translation_m[..., None])[..., 0])

    def __matmul__(self, other: "Pose[Array]") -> "Pose[Array]":
        """a_from_c of ``a_from_b @ b_from_c``."""
        moved = (self.rotation @ other.translation_m[..., None])[..., 0]
        return Pose(self.rotation @ other.rotation, moved + self.translation_m)

    def to(self, like: Tensor) -> "Pose[Tensor]":
        """This pose as tensors with the type and device of ``like``."""
        return Pose(torch.as_tensor(self.rotation).to(like), torch.as_tensor(self.translation_m).to(like))


def _unit(vector: Tensor, fallback: Tensor) -> Tensor:
    """``vector / |vector|``, or ``fallback`` without a gradient where the vector has no direction.

    ``where`` is applied to the input and not to the result, because a NaN in the branch not taken would still reach the
    gradient. Dividing by the largest component first keeps the squares of huge vectors finite.
    """
    largest = vector.detach().abs().amax(dim=-1, keepdim=True)
    safe = torch.where(largest > _SHORTEST, vector / largest.clamp(min=_SHORTEST), fallback)
    return safe / safe.square().sum(dim=-1, keepdim=True).sqrt()


def _any_perpendicular(unit: Tensor) -> Tensor:
    """Some vector perpendicular to each unit vector, never short."""
    x, y, z = unit.detach().unbind(-1)
    zero = torch.zeros_like(x)
    use_x = (x.abs() > z.abs()).unsqueeze(-1)
    return torch.where(use_x, torch.stack([-y, x, zero], dim=-1), torch.stack([zero, -z, y], dim=-1))


def _without(vector: Tensor, unit: Tensor) -> Tensor:
    """A vector minus its component along a unit vector."""
    return vector - (unit * vector).sum(dim=-1, keepdim=True) * unit


def matrix_from_rotation_6d(rotation_6d: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrix of a 6D rotation by Gram–Schmidt, Zhou et al. 2019, section B.

    Any finite input gives a rotation with finite gradients: the x axis replaces a first column that is too short, any
    perpendicular replaces a second one that is too short or parallel to the first.
    """
    first, second = rotation_6d[..., :3], rotation_6d[..., 3:]
    x = _unit(first, torch.eye(3, dtype=first.dtype, device=first.device)[0].expand_as(first))
    # The second column is normalised first, so that "parallel" means the same at every scale.
    second = _unit(second, _any_perpendicular(x))
    y = _unit(_without(second, x), _any_perpendicular(x))
    # Twice, because nearly parallel columns leave mostly rounding errors after the first pass.
    y = _unit(_without(y, x), _any_perpendicular(x))
    return torch.stack([x, y, torch.linalg.cross(x, y)], dim=-1)


def rotation_6d_from_matrix(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 6"]:
    """The first two columns, column after column."""
    return torch.cat([rotation[..., 0], rotation[..., 1]], dim=-1)


def matrix_from_yaw(yaw_ij: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation about the world's y axis (up, right-handed) by atan2(j, i), whatever the length of (i, j).

    (0, 0) gives the identity, with finite gradients.
    """
    forward = torch.eye(2, dtype=yaw_ij.dtype, device=yaw_ij.device)[0].expand_as(yaw_ij)
    cos, sin = _unit(yaw_ij, forward).unbind(-1)
    zero, one = torch.zeros_like(cos), torch.ones_like(cos)
    rows = [cos, zero, sin, zero, one, zero, -sin, zero, cos]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def direction_from_hemisphere(light: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
    """Unit vector above the ground (world frame, y up) from (x / y, z / y).

    Every pair of real numbers gives a direction above the horizon; (0, 0) is straight up.
    """
    x, z = light.unbind(-1)
    vector = torch.stack([x, torch.ones_like(x), z], dim=-1)
    return vector / torch.linalg.vector_norm(vector, dim=-1, keepdim=True)


def random_rotations(count: int, generator: np.random.Generator) -> Float[Tensor, "count 3 3"]:
    """Rotations uniform on SO(3): unit quaternions of normally distributed components (Shoemake 1992)."""
    quaternions = generator.standard_normal((count, 4))
    return torch.from_numpy(Rotation.from_quat(quaternions).as_matrix()).to(torch.float32)


def rotation_between(
    source: Float[Tensor, "*#batch 3"], target: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "... 3 3"]:
    """The smallest rotation from the direction ``source`` to ``target`` (Rodrigues), whatever their lengths.

    For opposite directions the axis is undefined and the result is not a rotation.
    """
    source = source / torch.linalg.vector_norm(source, dim=-1, keepdim=True)
    target = target / torch.linalg.vector_norm(target, dim=-1, keepdim=True)
    cos = (source * target).sum(dim=-1)[..., None, None]
    outer = target.unsqueeze(-1) * source.unsqueeze(-2)
    skew = outer - outer.transpose(-1, -2)
    identity = torch.eye(3, dtype=source.dtype, device=source.device)
    return identity + skew + skew @ skew / (1 + cos).clamp(min=_SHORTEST)


def rotation_angle_deg(a: Float[Tensor, "*#batch 3 3"], b: Float[Tensor, "*#batch 3 3"]) -> Float[Tensor, "..."]:
    """Angle of the relative rotation, in [0, 180] degrees.

    atan2 of sine and cosine is exact at both ends, where the usual arccos((trace - 1) / 2) loses half its digits.
    """
    between = a.transpose(-1, -2) @ b
    skew = between - between.transpose(-1, -2)
    twice_sin = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1).norm(dim=-1)
    twice_cos = between.diagonal(dim1=-2, dim2=-1).sum(dim=-1) - 1
    return torch.rad2deg(torch.atan2(twice_sin, twice_cos))


def camera_looking_at(eye: Float[Tensor, "*#batch 3"], target: Float[Tensor, "*#batch 3"]) -> Pose[Tensor]:
    """cam_from_world of an OpenCV camera at ``eye`` (world frame, y up) that points at ``target`` without roll.

    Straight up or down, where roll is not defined, the image's x axis is the world's.
    """
    forward = target - eye
    forward = forward / torch.linalg.vector_norm(forward, dim=-1, keepdim=True)
    down = forward.new_tensor([0.0, -1.0, 0.0]).expand_as(forward)
    right = _unit(torch.linalg.cross(down, forward), forward.new_tensor([1.0, 0.0, 0.0]).expand_as(forward))
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=-2)
    return Pose(rotation, -(rotation @ eye.unsqueeze(-1)).squeeze(-1))
