"""The symmetries of a model's objects as rotations."""

import math

import numpy as np
from curio_proto.v1.model_spec_pb2 import ObjectModel

from curio_serve.imaging.rotation import from_rotation_vector

Array = np.ndarray
_SYMMETRY_STEP_RAD = math.radians(5)


def symmetry_rotations(kind: ObjectModel) -> Array:
    """Rotations [n, 3, 3] of an object onto itself; continuous symmetries in steps."""
    discrete = [np.reshape(s.transform, (4, 4))[:3, :3] for s in kind.symmetries if len(s.transform) == 16]
    found = np.stack([np.eye(3), *discrete])
    for symmetry in kind.symmetries:
        if len(symmetry.axis) == 3:
            angles = np.arange(0, 2 * math.pi, _SYMMETRY_STEP_RAD)
            rotations = from_rotation_vector(angles[:, None] * np.array(symmetry.axis))
            found = (found[:, None] @ rotations[None]).reshape(-1, 3, 3)
    return found
