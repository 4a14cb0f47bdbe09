"""Moves the estimates of a real frame onto the plane on which its objects stand, as ``curio-detect --plane`` does."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from curio_serve.models.object_frames import middle_from_origin, origin_from_middle
from curio_serve.planes.plane import AnyPlane, Plane
from curio_serve.planes.standing import Standing, distance_factor, find_plane

from curio_train.errors import UsageError
from curio_train.evaluation.real_scores import Estimate
from curio_train.geometry import Pose
from curio_train.meshes.stable_poses import stable_up
from curio_train.worlds.base import ObjectKind


@dataclass(frozen=True, eq=False)
class Shape:
    """What :class:`~curio_serve.planes.standing.Standing` needs of a kind of object, in its frame."""

    center_m: np.ndarray
    """[3]."""
    hull_m: np.ndarray
    """[n, 3]."""
    up: np.ndarray
    """[k, 3]."""


def shapes_of(kinds: Sequence[ObjectKind]) -> list[Shape]:
    """The shapes of a world's objects.

    Raises:
        UsageError: They always stand in the same way, or are flat.
    """
    found = [Shape(np.array(k.center_m), k.hull_m, stable_up(k.hull_m)) for k in kinds if k.hull_m is not None]
    if len(found) < len(kinds):
        raise UsageError("--plane is for objects that may stand in any way; leave it out")
    return found


def standing_on(estimates: Sequence[Estimate], shapes: Sequence[Shape], plane: AnyPlane) -> list[Estimate]:
    """The estimates of one frame, moved along their lines of sight until the objects stand, where they can.

    Args:
        estimates: One for each object.
        shapes: Of the same objects.
        plane: In the frame's camera, or that it is to be found.
    """
    pairs = list(zip(estimates, shapes, strict=True))
    standing = [_standing(estimate, shape) for estimate, shape in pairs]
    found = plane if isinstance(plane, Plane) else find_plane(standing)
    if found is None:
        return list(estimates)
    factors = [distance_factor(one, found, is_known=found is plane) for one in standing]
    return [_moved(*pair, one) for pair, one in zip(pairs, factors, strict=True)]


def _standing(estimate: Estimate, shape: Shape) -> Standing:
    pose = estimate.pose
    middle_m = middle_from_origin(pose.translation_m, pose.rotation, shape.center_m)
    return Standing(estimate.confidence, middle_m, pose.apply(shape.hull_m), shape.up @ pose.rotation.T)


def _moved(estimate: Estimate, shape: Shape, factor: float | None) -> Estimate:
    if factor is None:
        return estimate
    rotation = estimate.pose.rotation
    middle_m = factor * middle_from_origin(estimate.pose.translation_m, rotation, shape.center_m)
    return replace(estimate, pose=Pose(rotation, origin_from_middle(middle_m, rotation, shape.center_m)))
