"""Reads how a model's objects can stand, which training computes from their meshes and stores beside the model.

``stable_poses.json`` holds a ``StablePoses`` message. Models without the file answer as they did, and refuse to move
objects onto a plane.
"""

from collections.abc import Sequence

import numpy as np
from curio_proto.v1.model_spec_pb2 import ObjectStablePoses, StablePoses

from curio_serve.beside import parsed_message, refuse_other_objects
from curio_serve.errors import ModelError

STABLE_POSES_FILE = "stable_poses.json"
_REMEDY = "export the run again"
_FARTHEST_M = 100.0
_UNIT = 1e-3  # how far a direction's length may be from 1


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
