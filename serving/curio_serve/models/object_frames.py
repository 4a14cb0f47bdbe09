"""What a model says about its objects' own frames: their symmetries, and their middle.

A network reads where an object's middle is, and its graph answers where the origin of the mesh file is. Whatever
compares or averages poses, or looks for an object in a frame, does so with the middle: every symmetry leaves it in its
place, and it lies within the object's box.
"""

import math
from collections.abc import Sequence

import numpy as np
from curio_proto.v1.model_spec_pb2 import ObjectModel

from curio_serve.imaging.rotation import are_several_axes, from_rotation_vector

Array = np.ndarray
_SYMMETRY_STEP_RAD = math.radians(5)


def symmetry_rotations(kind: ObjectModel) -> Array:
    """Rotations [n, 3, 3] of an object onto itself, about its middle; continuous symmetries in steps.

    Of an object that turns any way the identity alone: see :func:`as_compared`.
    """
    if turns_any_way(kind):
        return np.eye(3)[None]
    discrete = [np.reshape(s.transform, (4, 4))[:3, :3] for s in kind.symmetries if len(s.transform) == 16]
    found = np.stack([np.eye(3), *discrete])
    for symmetry in kind.symmetries:
        if len(symmetry.axis) == 3:
            angles = np.arange(0, 2 * math.pi, _SYMMETRY_STEP_RAD)
            rotations = from_rotation_vector(angles[:, None] * np.array(symmetry.axis))
            found = (found[:, None] @ rotations[None]).reshape(-1, 3, 3)
    return found


def turns_any_way(kind: ObjectModel) -> bool:
    """Whether every rotation of an object looks alike, as a ball's do: it has several axes of continuous symmetry."""
    return are_several_axes([np.array(symmetry.axis) for symmetry in kind.symmetries if len(symmetry.axis) == 3])


def as_compared(rotation: Array, kind: ObjectModel) -> Array:
    """Rotations [..., 3, 3] as they are compared and averaged: the identity where every rotation looks alike."""
    return np.broadcast_to(np.eye(3), rotation.shape) if turns_any_way(kind) else rotation


def center_of(kind: ObjectModel) -> Array:
    """An object's middle [3], object frame, metres: the origin, where its model names no other point."""
    return np.array(kind.center_m) if kind.center_m else np.zeros(3)


def middle_from_origin(origin_m: Array, rotation: Array, center_m: Array) -> Array:
    """Positions of the middles, [..., 3].

    Args:
        origin_m: Where the origins are, [..., 3]: the translation of cam_from_obj.
        rotation: Of cam_from_obj, [..., 3, 3].
        center_m: Of :func:`center_of`.
    """
    result: Array = origin_m + rotation @ center_m
    return result


def origin_from_middle(middle_m: Array, rotation: Array, center_m: Array) -> Array:
    """Positions of the origins, [..., 3]; the inverse of :func:`middle_from_origin`."""
    result: Array = middle_m - rotation @ center_m
    return result


def transformed(
    points: Sequence[Sequence[float]], rotation: Sequence[float], translation: Sequence[float]
) -> Sequence[Sequence[float]]:
    """An object's points in the frame's camera, metres.

    Args:
        points: Object frame, metres.
        rotation: Of cam_from_obj, 9 values row after row.
        translation: Of cam_from_obj, metres.
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = rotation
    x, y, z = translation
    return [
        (xx * a + xy * b + xz * c + x, yx * a + yy * b + yz * c + y, zx * a + zy * b + zz * c + z) for a, b, c in points
    ]
