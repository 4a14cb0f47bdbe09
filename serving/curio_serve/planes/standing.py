"""Finds the plane on which a frame's objects stand, and how far away an object is that stands on a plane.

The distance is what a network reads worst: it is off by a hundredth or two, several times as far as the place across
the view. A known plane says how far away an object is that stands on it. Where the plane is not known, the objects tell
it: a body stands on few of its sides only, so each pose proposes a few planes, and the answer is the one on which most
objects stand.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from curio_serve.planes.plane import Plane

Array = np.ndarray
DEPTH_STD = 0.015
"""Standard deviation of a distance that a network reads, fraction of the distance."""
HEIGHT_STD = 0.004
"""Of the height of an object's lowest point over the plane, fraction of the same distance: meshes end where scanners
stopped, tables bend, and planes are measured."""
_TILT_STD = 0.08
"""Of the angle between the plane and a side that an object stands on, radians."""
_MOST_TILT = 0.3
"""Objects that lean farther from every side that they can stand on tell no plane, and do not move to one, radians."""
_MOST_DEVIATIONS = 4.0
"""Objects whose distance would change by more than that many standard deviations are not on the plane."""
_LEAST_EVIDENCE, _LEAST_OBJECTS = 0.2, 2
"""That many objects have to stand on a plane, each with a likelihood of that part of the largest."""
_LEAST_WEIGHT = 0.05  # below, objects are rarely there: what is seen in an empty scene may agree by chance
_MOST_OBJECTS = 32  # that tell a plane: more make it no better, and time grows with their cube
_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class Standing:
    """An object's pose, and how it can stand."""

    weight: float
    """Its confidence."""
    middle_m: Array
    """[3], camera frame."""
    hull_m: Array
    """Points of its convex hull, [n, 3], camera frame."""
    up: Array
    """For each of its stable poses the unit vector that points away from the plane, [k, 3], camera frame."""


def find_plane(objects: Sequence[Standing]) -> Plane | None:
    """The plane on which most of the objects stand; None where no two of them agree on one.

    An object that was found twice, in two regions of a frame, counts once.
    """
    objects = _at_different_places(objects)
    candidates = [one.up[one.up @ one.middle_m < 0] for one in objects]  # seen from above
    if len(objects) < _LEAST_OBJECTS or not any(map(len, candidates)):
        return None
    normals = np.concatenate(candidates)
    heights_m, tilts = _heights_m(normals, objects), _tilts(normals, objects)
    stds_m, weights = _height_stds_m(normals, objects), [one.weight for one in objects]
    best, found = 0.0, None
    for offsets_m in heights_m.T:
        scores = _likelihoods(tilts, (heights_m - offsets_m[:, None]) / stds_m) @ weights
        row = int(scores.argmax())
        if scores[row] > best:
            best, found = float(scores[row]), (normals[row], float(offsets_m[row]))
    return None if found is None else _fitted(*found, objects)


def _at_different_places(objects: Sequence[Standing]) -> list[Standing]:
    """The objects that can tell a plane, the surest of those at one place, and of very many the surest."""
    kept: list[Standing] = []
    for one in sorted(objects, key=lambda one: -one.weight):
        if one.weight < _LEAST_WEIGHT or not len(one.up) or len(kept) == _MOST_OBJECTS:
            continue
        radius_m = np.linalg.norm(one.hull_m - one.middle_m, axis=1).max()
        if all(np.linalg.norm(one.middle_m - other.middle_m) > radius_m / 2 for other in kept):
            kept.append(one)
    return kept


def distance_factor(one: Standing, plane: Plane, *, is_known: bool) -> float | None:
    """By which factor an object's distance changes where it stands on a plane; None where it does not stand there.

    The factor is the likeliest, given how far a network's distances and an object's height over a plane are off. It
    goes nine tenths of the way to a plane that the camera looks down on, and less to one that it looks along.

    Args:
        one: The object.
        plane: On which it may stand.
        is_known: As of :func:`height_over`.
    """
    height_m = height_over(one, plane, is_known=is_known)
    if height_m is None:
        return None
    down_m = -float(plane.normal @ one.middle_m)
    std = HEIGHT_STD * float(np.linalg.norm(one.middle_m)) / down_m
    return 1 + height_m / down_m * DEPTH_STD**2 / (DEPTH_STD**2 + std**2)


def height_over(one: Standing, plane: Plane, *, is_known: bool) -> float | None:
    """How far an object that stands on a plane was read above it, metres; None where it does not stand there.

    Args:
        one: The object.
        plane: On which it may stand.
        is_known: The plane was given: objects that lean on it touch it, too. Otherwise it was found, and objects stand
            on one of their sides.
    """
    if not is_known and (not len(one.up) or np.linalg.norm(one.up - plane.normal, axis=1).min() > _MOST_TILT):
        return None
    down_m, distance_m = -float(plane.normal @ one.middle_m), float(np.linalg.norm(one.middle_m))
    if down_m <= HEIGHT_STD * distance_m:
        return None
    height_m = float((one.hull_m @ plane.normal).min()) - plane.offset_m
    if abs(height_m) > _MOST_DEVIATIONS * np.hypot(DEPTH_STD * down_m, HEIGHT_STD * distance_m):
        return None
    return height_m


def _fitted(normal: Array, offset_m: float, objects: Sequence[Standing]) -> Plane | None:
    """The plane that fits a candidate's supporters best, by least squares, reweighted a few times."""
    weights = np.array([one.weight for one in objects])
    sides = np.stack([one.up[np.linalg.norm(one.up - normal, axis=1).argmin()] for one in objects])
    for _ in range(_ROUNDS):
        fits = _fits(normal, offset_m, objects)
        contacts_m = np.stack([one.hull_m[(one.hull_m @ normal).argmin()] for one in objects])
        height = np.sqrt(weights * fits) / _height_stds_m(normal[None], objects)[0]
        tilt = np.sqrt(weights * fits) / _TILT_STD
        rows = np.concatenate([np.c_[contacts_m, -np.ones(len(objects))] * height[:, None], *_turned_by(tilt)])
        values = np.concatenate([np.zeros(len(objects)), (sides * tilt[:, None]).T.ravel()])
        found = np.linalg.lstsq(rows, values, rcond=None)[0]
        length = float(np.linalg.norm(found[:3]))
        if length < 0.5:  # sides that point everywhere
            return None
        normal, offset_m = found[:3] / length, float(found[3]) / length
    if (_fits(normal, offset_m, objects) > _LEAST_EVIDENCE).sum() < _LEAST_OBJECTS or offset_m >= 0:
        return None
    return Plane(normal * offset_m, normal)


def _turned_by(tilt: Array) -> list[Array]:
    """Rows of the least squares that hold the normal's three entries to each side's, [n, 4] each."""
    return [np.eye(4)[axis] * tilt[:, None] for axis in range(3)]


def _fits(normal: Array, offset_m: float, objects: Sequence[Standing]) -> Array:
    """How well each object stands on a plane, 0 to 1, [objects]."""
    normals = normal[None]
    off = (_heights_m(normals, objects) - offset_m) / _height_stds_m(normals, objects)
    return _likelihoods(_tilts(normals, objects), off)[0]


def _likelihoods(tilts: Array, off: Array) -> Array:
    """The same of angles, and of heights in standard deviations."""
    result: Array = np.exp(-0.5 * (tilts / _TILT_STD) ** 2 - 0.5 * off**2)
    return result


def _tilts(normals: Array, objects: Sequence[Standing]) -> Array:
    """The angle between each plane and the nearest side of each object, radians, [planes, objects]."""
    return np.stack([np.linalg.norm(normals[:, None] - one.up, axis=-1).min(axis=1) for one in objects], axis=1)


def _heights_m(normals: Array, objects: Sequence[Standing]) -> Array:
    """The lowest point of each object along each normal, [planes, objects]."""
    return np.stack([(normals @ one.hull_m.T).min(axis=1) for one in objects], axis=1)


def _height_stds_m(normals: Array, objects: Sequence[Standing]) -> Array:
    """Standard deviation of those, as the distances that a network reads make it, [planes, objects]."""
    along_m = np.stack([normals @ one.middle_m for one in objects], axis=1)
    return np.hypot(DEPTH_STD * along_m, HEIGHT_STD * np.linalg.norm([one.middle_m for one in objects], axis=1))
