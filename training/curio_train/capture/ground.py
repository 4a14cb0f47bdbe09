"""From a reconstruction's arbitrary frame to the world's: origin on the ground, y up, metres."""

from dataclasses import replace

import numpy as np

from curio_train.capture.structure import Structure
from curio_train.errors import CameraError
from curio_train.geometry import Pose

_OFF_PLANE = 0.01  # of the distance from cameras to points: what still counts as ground
_FEWEST_ON_GROUND = 0.2  # fraction of the points
_TRIALS = 500
_LOWEST_VIEW = 0.05  # sine of the angle by which the first camera must look down


def _plane(points: np.ndarray, tolerance: float) -> tuple[np.ndarray, float, float]:
    """The plane n · p = d near most of the points [n, 3] (RANSAC), fitted to those: n, d and their fraction."""
    random = np.random.default_rng(0)
    best = np.zeros(len(points), dtype=bool)
    for corners in points[random.integers(len(points), size=(_TRIALS, 3))]:
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        length = np.linalg.norm(normal)
        if length > 0:
            close = np.abs((points - corners[0]) @ normal) < tolerance * length
            best = close if close.sum() > best.sum() else best
    centre = points[best].mean(axis=0)
    normal = np.linalg.svd(points[best] - centre, full_matrices=False)[2][2]
    return normal, float(normal @ centre), float(best.mean())


def to_world(structure: Structure) -> Structure:
    """A structure moved to the world's frame, still of arbitrary scale.

    The plane that most points lie on becomes y = 0, cameras stand above it. The origin is what the first camera's
    optical axis meets there; that camera stands towards +z.

    Raises:
        CameraError: No plane holds enough of the points, or the first camera does not look down on it.
    """
    centres = structure.centres
    distance = float(np.median(np.linalg.norm(structure.points - centres[0], axis=1)))
    up, offset, fraction = _plane(structure.points, _OFF_PLANE * distance)
    if fraction < _FEWEST_ON_GROUND:
        raise CameraError(
            f"found no ground: the best plane holds {fraction:.0%} of the {len(structure.points)} points, expected "
            f"{_FEWEST_ON_GROUND:.0%}; let the photographs show more of the table, with a pattern on it"
        )
    if np.median(centres @ up) < offset:
        up, offset = -up, -offset
    forward = structure.cam_from_world[0, 2, :3]
    if forward @ up > -_LOWEST_VIEW:
        raise CameraError("the first camera does not look down on the ground; begin with one that does")
    origin = centres[0] + forward * (offset - centres[0] @ up) / (forward @ up)
    backward = -forward + (forward @ up) * up
    if np.linalg.norm(backward) < _LOWEST_VIEW:  # straight from above: the image's lower edge is nearest
        backward = structure.cam_from_world[0, 1, :3]
        backward = backward - (backward @ up) * up
    backward = backward / np.linalg.norm(backward)
    world_from_old = np.eye(4)
    world_from_old[:3, :3] = np.stack([np.cross(up, backward), up, backward])
    world_from_old[:3, 3] = -world_from_old[:3, :3] @ origin
    return _moved(structure, world_from_old)


def _moved(structure: Structure, new_from_old: np.ndarray) -> Structure:
    points = Pose.from_matrix(new_from_old).apply(structure.points)
    return replace(structure, points=points, cam_from_world=structure.cam_from_world @ np.linalg.inv(new_from_old))


def scaled(structure: Structure, factor: float) -> Structure:
    """A structure scaled about the origin by a factor."""
    matrices = structure.cam_from_world.copy()
    matrices[:, :3, 3] *= factor
    return replace(structure, points=structure.points * factor, cam_from_world=matrices)


def scale_by_distance(structure: Structure, first: int, second: int, distance_m: float) -> Structure:
    """Scale a structure to metres by the known distance of two cameras.

    Raises:
        CameraError: The two stood at one place, or the distance is none.
    """
    found = float(np.linalg.norm(structure.centres[first] - structure.centres[second]))
    span = float(np.ptp(structure.centres, axis=0).max())
    if not distance_m > 0 or found < 1e-3 * span:
        raise CameraError(
            f"cameras {first} and {second} are to be {distance_m} m apart, found {found:.3g} of {span:.3g}"
        )
    return scaled(structure, distance_m / found)
