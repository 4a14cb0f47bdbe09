"""Moves the estimates of a real frame onto the plane on which its objects stand, as ``curio-detect --plane`` does.

The worlds that have real frames read where the origins of meshes are, and take them for the objects' middles.
"""

from collections.abc import Sequence
from dataclasses import replace

from curio_serve.planes.camera_poses import GivenPlane
from curio_serve.planes.plane import FIND_PLANE, AnyPlane, Plane
from curio_serve.planes.stable_poses import StandingShape
from curio_serve.planes.standing import distance_factor, find_plane

from curio_train.errors import UsageError
from curio_train.evaluation.real_scores import Estimate
from curio_train.geometry import Pose
from curio_train.meshes.stable_poses import stable_up
from curio_train.worlds.base import ObjectKind


def shapes_of(kinds: Sequence[ObjectKind], plane: GivenPlane) -> list[StandingShape]:
    """The shapes of a world's objects, for planes that are given or found.

    Raises:
        UsageError: They always stand in the same way, or are flat; or it is one object, of which no plane is found.
    """
    if plane == FIND_PLANE and len(kinds) == 1:
        raise UsageError(f"--plane objects: one object, {kinds[0].name}, stands on any plane; give a file of the plane")
    found = [StandingShape(k.hull_m, stable_up(k.hull_m)) for k in kinds if k.hull_m is not None]
    if len(found) < len(kinds):
        raise UsageError("--plane is for objects that may stand in any way; leave it out")
    return found


def standing_on(estimates: Sequence[Estimate], shapes: Sequence[StandingShape], plane: AnyPlane) -> list[Estimate]:
    """The estimates of one frame, moved along their lines of sight until the objects stand, where they can.

    Args:
        estimates: One for each object.
        shapes: Of the same objects.
        plane: In the frame's camera, or that it is to be found.
    """
    standing = [
        shape.at(estimate.pose.translation_m, estimate.pose.rotation, estimate.confidence)
        for estimate, shape in zip(estimates, shapes, strict=True)
    ]
    found = plane if isinstance(plane, Plane) else find_plane(standing)
    if found is None:
        return list(estimates)
    factors = [distance_factor(one, found, is_known=found is plane) for one in standing]
    return [_moved(estimate, one) for estimate, one in zip(estimates, factors, strict=True)]


def _moved(estimate: Estimate, factor: float | None) -> Estimate:
    if factor is None:
        return estimate
    return replace(estimate, pose=Pose(estimate.pose.rotation, factor * estimate.pose.translation_m))
