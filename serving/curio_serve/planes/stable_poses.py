"""Reads how a model's objects can stand, which training computes from their meshes and stores beside the model.

``stable_poses.json`` holds a ``StablePoses`` message. Models without the file answer as they did, and refuse to move
objects onto a plane.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from curio_proto.v1.model_spec_pb2 import ObjectStablePoses, StablePoses

from curio_serve.beside import parsed_message, refuse_other_objects
from curio_serve.errors import ModelError
from curio_serve.planes.standing import Standing

Array = np.ndarray
STABLE_POSES_FILE = "stable_poses.json"
_REMEDY = "export the run again"
_FARTHEST_M = 100.0
_UNIT = 1e-3  # how far a direction's length may be from 1


@dataclass(frozen=True, eq=False)
class StandingShape:
    """How one kind of object can stand, about its middle."""

    hull_m: Array
    """Points of its convex hull, [n, 3], object frame."""
    up: Array
    """For each of its stable poses the unit vector that points away from the plane, [k, 3], object frame."""

    @classmethod
    def of(cls, stored: ObjectStablePoses, center_m: Array) -> "StandingShape":
        """The shape of an object whose middle is there [3], object frame."""
        return cls(np.reshape(stored.hull_m, (-1, 3)) - center_m, np.reshape(stored.up, (-1, 3)))

    def at(self, middle_m: Array, rotation: Array, weight: float) -> Standing:
        """The object in a frame.

        Args:
            middle_m: Where its middle is [3], camera frame.
            rotation: cam_from_obj [3, 3].
            weight: Its confidence.
        """
        return Standing(weight, middle_m, self.hull_m @ rotation.T + middle_m, self.up @ rotation.T)


def parse_stable_poses(text: bytes, objects: Sequence[str], where: str) -> StablePoses:
    """How the objects of a model can stand.

    Args:
        text: Content of the file.
        objects: Names of the model's objects.
        where: The file, for messages.

    Raises:
        ModelError: It is no StablePoses, has impossible values, or is about other objects.
    """
    found = parsed_message(text, StablePoses(), where, "curio-export")
    refuse_other_objects(found.objects, objects, where, _REMEDY)
    if not all(map(_is_possible, found.objects)):
        raise ModelError(f"{where} has impossible values; {_REMEDY}")
    return found


def _is_possible(one: ObjectStablePoses) -> bool:
    if not one.hull_m or len(one.hull_m) % 3 or len(one.up) % 3:
        return False
    hull_m, up = np.reshape(one.hull_m, (-1, 3)), np.reshape(one.up, (-1, 3))
    is_unit = np.abs(np.linalg.norm(up, axis=1) - 1) < _UNIT
    return bool((np.abs(hull_m) < _FARTHEST_M).all() and is_unit.all())  # NaN is neither
