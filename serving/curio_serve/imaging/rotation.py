"""Rotations as serving needs them: few, small, and without a package that takes half a second to load."""

import math
from collections.abc import Sequence

import numpy as np

Array = np.ndarray
_PARALLEL = 0.01  # axes of unit length that differ by less are one


def are_several_axes(axes: Sequence[Array]) -> bool:
    """Whether axes, each [3] of length 1, are more than one: others are parallel, up to rounding."""
    return len(axes) > 1 and bool(np.linalg.matrix_rank(np.stack(axes), tol=_PARALLEL) > 1)


def smallest_rotation(source: Array, target: Array) -> Array:
    """Rotation [3, 3] that takes one unit vector [3] to another on the shortest way (Rodrigues' formula).

    Both look forward (z > 0), so they are never opposite.
    """
    (a, b, c), (p, q, r) = source.tolist(), target.tolist()
    x, y, z = b * r - c * q, c * p - a * r, a * q - b * p
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + cross + cross @ cross / (1 + a * p + b * q + c * r)


def quaternion_xyzw(rows: Sequence[float]) -> tuple[float, float, float, float]:
    """Unit quaternion of a rotation matrix, by its largest component (Shepperd 1978), w not negative.

    Args:
        rows: The matrix's 9 values, row after row.
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = rows
    w, x, y, z = 1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz  # four times their squares
    largest = max(w, x, y, z)
    if largest == w:
        w, x, y, z = w, zy - yz, xz - zx, yx - xy
    elif largest == x:
        w, x, y, z = zy - yz, x, yx + xy, xz + zx
    elif largest == y:
        w, x, y, z = xz - zx, yx + xy, y, zy + yz
    else:
        w, x, y, z = yx - xy, xz + zx, zy + yz, z
    scale = math.copysign(1 / math.hypot(w, x, y, z), w)
    return x * scale, y * scale, z * scale, w * scale


def from_rotation_vector(vector: Array) -> Array:
    """Rotations [..., 3, 3] about axes by angles: vectors [..., 3] in radians (Rodrigues' formula)."""
    x, y, z = np.moveaxis(np.asarray(vector, float), -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)
    angle = np.sqrt(x * x + y * y + z * z)[..., None, None]
    sine, versine = np.sinc(angle / np.pi), np.sinc(angle / (2 * np.pi)) ** 2 / 2  # divided by angle and its square
    result: Array = np.eye(3) + sine * cross + versine * (cross @ cross)
    return result


def rotation_vector(rotation: Array) -> Array:
    """The vector [3] of a rotation [3, 3]: along its axis, as long as its angle, at most pi."""
    x, y, z, w = quaternion_xyzw(rotation.ravel().tolist())
    sine = math.hypot(x, y, z)
    result: Array = np.array([x, y, z]) * (2 * math.atan2(sine, w) / sine if sine > 1e-12 else 2.0)
    return result


def is_rotation(matrix: Array, tolerance: float) -> bool:
    """Whether a matrix [3, 3] is a rotation; the product with its transpose may be so far from the identity."""
    return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() <= tolerance and np.linalg.det(matrix) >= 0)
