"""Rotations that carry a shape onto itself, found from the mesh and written as BOP's ``models_info.json`` has them.

A rotation counts as a symmetry when, of points spread evenly over the rotated surface, 95 % lie within
:data:`TOLERANCE` of the surface and all within :data:`LARGEST_MISS`; both are fractions of the diameter, and the
rotation is fitted first. BOP's annotation of scanned objects allows such deviations, too: the two symmetric objects of
LM-O deviate by 1.7 % and 4.9 %, the closest of the others by 4.4 % and 11 %. Only geometry is compared: paint may tell
sides apart that this module calls the same.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from curio_train.meshes.meshes import Mesh

TOLERANCE = 0.025
LARGEST_MISS = 0.07
LARGEST_ORDER = 12
_NUM_TURNED, _NUM_STILL = 3000, 12_000
_COARSE = 2.5  # a candidate that is not fitted yet may miss by so many tolerances
_CLEARLY_LESS = 0.4
_NOISE, _SHARED_NOISE = 0.01, 3.0  # of the diameter; a factor
_EQUAL_MOMENTS = 0.1  # moments of inertia that differ by less may belong to one plane of symmetry axes
_FIT_STEPS = 25
_NUM_DIRECTIONS = 700  # of a half sphere: one every 5°
_PARALLEL = 0.999  # cosine of the angle between two axes
_SAME_DEG = 12.0  # turns of different symmetries are at least 30° apart, their axes 15°
_DRIFT_DEG = 5.0  # of the angle, while the axis is fitted
_PROBE_ANGLES_DEG = (19.0, 47.0, 73.0, 101.0, 137.0, 163.0)  # multiples of no 360°/n up to the largest order


@dataclass(frozen=True)
class Symmetries:
    """The rotations that map the shape onto itself, without the identity."""

    discrete: tuple[np.ndarray, ...]
    """Each [4, 4], object frame, metres."""
    continuous: tuple[tuple[np.ndarray, np.ndarray], ...]
    """Each (unit axis [3], point on it in metres [3]); any turn about it counts."""

    def point_left(self, near_m: np.ndarray) -> np.ndarray:
        """The point [3] nearest to a given one that every symmetry leaves in its place; object frame, metres."""
        rows, moved_m = [np.zeros((1, 3))], [np.zeros(1)]
        for matrix in self.discrete:
            rows.append(np.eye(3) - matrix[:3, :3])
            moved_m.append(matrix[:3, 3] - rows[-1] @ near_m)
        for axis, point in self.continuous:
            rows.append(np.eye(3) - np.outer(axis, axis))
            moved_m.append(rows[-1] @ (point - near_m))
        away_m, *_ = np.linalg.lstsq(np.concatenate(rows), np.concatenate(moved_m), rcond=1e-3)
        result: np.ndarray = near_m + away_m
        return result

    def about(self, axis: np.ndarray) -> "Symmetries":
        """The symmetries that keep the direction of an axis [3] of length 1."""
        return Symmetries(
            tuple(matrix for matrix in self.discrete if axis @ matrix[:3, :3] @ axis > _PARALLEL),
            tuple((own, point) for own, point in self.continuous if abs(own @ axis) > _PARALLEL),
        )

    def leaving(self, point_m: np.ndarray, largest_m: float) -> "Symmetries":
        """The symmetries that move a point [3] by no more than some distance, metres."""
        return Symmetries(
            tuple(m for m in self.discrete if np.linalg.norm(m[:3, :3] @ point_m + m[:3, 3] - point_m) <= largest_m),
            tuple((a, at) for a, at in self.continuous if np.linalg.norm(np.cross(a, point_m - at)) <= largest_m),
        )

    def in_frame(self, rotation: np.ndarray, translation_m: np.ndarray) -> "Symmetries":
        """The symmetries in another frame, which new_from_own leads to: rotation [3, 3], then translation [3]."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation, translation_m
        discrete = tuple(matrix @ motion @ np.linalg.inv(matrix) for motion in self.discrete)
        return Symmetries(
            discrete, tuple((rotation @ axis, rotation @ at + translation_m) for axis, at in self.continuous)
        )

    def as_bop(self) -> dict[str, list[object]]:
        """Fields ``symmetries_discrete`` and ``symmetries_continuous`` of BOP, in mm; none that would be empty."""
        fields: dict[str, list[object]] = {}
        if self.discrete:
            fields["symmetries_discrete"] = [_in_millimetres(matrix) for matrix in self.discrete]
        if self.continuous:
            fields["symmetries_continuous"] = [
                {"axis": axis.tolist(), "offset": (point * 1000).tolist()} for axis, point in self.continuous
            ]
        return fields


def _in_millimetres(matrix: np.ndarray) -> list[float]:
    scaled = matrix.copy()
    scaled[:3, 3] *= 1000
    return [float(value) for value in scaled.ravel()]


def find_symmetries(mesh: Mesh) -> Symmetries:
    """The rotational symmetries of a mesh's shape; reflections cannot be made with a rigid object and do not count.

    About a continuous axis, every flip across it is the same but for a turn about that axis: one is kept. Where there
    are two continuous axes it is a sphere, whose every turn is made of turns about these.
    """
    surface = _Surface(mesh)
    continuous: list[np.ndarray] = []
    discrete: list[np.ndarray] = []
    for axis in surface.candidate_axes():
        if (fitted := surface.continuous_axis(axis)) is not None:
            continuous += [fitted] * (not any(_same_line(fitted, known, _SAME_DEG) for known in continuous))
            if len(continuous) == 2:
                return Symmetries((), tuple((axis, surface.centre) for axis in continuous))
        elif not (continuous and discrete):
            discrete += [rotation for rotation in surface.rotations_about(axis) if not _is_known(rotation, discrete)]
    if continuous:
        discrete = discrete[:1]
    return Symmetries(tuple(surface.clear_ones(discrete)), tuple((axis, surface.centre) for axis in continuous))


class _Surface:
    """Points of a surface, and how far a turned copy lies from it; lengths in diameters, origin at its centroid."""

    def __init__(self, mesh: Mesh) -> None:
        shape = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
        points, faces = trimesh.sample.sample_surface(shape, _NUM_STILL, seed=0)
        # Not the points' mean, which is off by a hundredth of the size: exact symmetries would move the surface so far.
        self._size, self.centre = mesh.diameter_m, np.asarray(shape.centroid)
        self._second_moments = _second_moments((np.asarray(shape.triangles) - self.centre) / self._size)
        self._still = (np.asarray(points) - self.centre) / self._size
        self._triangles = (np.asarray(shape.triangles)[faces] - self.centre) / self._size
        self._tree = cKDTree(self._still)
        self._turned = self._still[:: _NUM_STILL // _NUM_TURNED]
        self._few = self._turned[::15]

    def candidate_axes(self) -> Iterator[np.ndarray]:
        """Unit axes about which the shape may be symmetric, most promising first but for the principal axes.

        An axis of symmetry is a principal axis of inertia. Where moments are equal, principal axes are not unique and a
        whole plane of directions, or all of them, must be searched. Where they are almost equal, as those of a box with
        sides of 78 and 71 mm, the principal axes are looked at as well: the search alone may take others near them.
        """
        moments, axes = np.linalg.eigh(self._second_moments)
        low, high = moments[1] < moments[0] * (1 + _EQUAL_MOMENTS), moments[2] < moments[1] * (1 + _EQUAL_MOMENTS)
        unique = [axes[:, i] for i, shared in enumerate((low, low or high, high)) if not shared]
        yield from axes.T
        if low and high:
            directions = _hemisphere(_NUM_DIRECTIONS)
        elif low or high:
            first, second = (axes[:, 0], axes[:, 1]) if low else (axes[:, 1], axes[:, 2])
            angles = np.radians(np.arange(0, 180, 2.5))[:, None]
            directions = np.cos(angles) * first + np.sin(angles) * second
        else:
            return
        least_miss, looked_at = np.array([self._least_miss(axis) for axis in directions]), unique
        for axis in directions[np.argsort(least_miss)][: int((least_miss < _COARSE * TOLERANCE).sum())]:
            if not any(_same_line(axis, other, _SAME_DEG) for other in looked_at):
                looked_at.append(axis)
                yield axis

    def _least_miss(self, axis: np.ndarray) -> float:
        """Smallest miss of a turn of prime order about an axis: turns of every other order contain such turns."""
        distances = [self._tree.query(self._few @ _about(axis, 2 * np.pi / order).T)[0] for order in (2, 3, 5, 7, 11)]
        return float(min(np.percentile(distance, 95) for distance in distances))

    def continuous_axis(self, axis: np.ndarray) -> np.ndarray | None:
        """The axis, fitted, where any turn about it leaves the surface in place."""
        fitted = self._fitted(axis, np.radians(_PROBE_ANGLES_DEG[0]))
        if fitted is None:
            return None
        rotations = (_about(fitted, np.radians(degrees)) for degrees in _PROBE_ANGLES_DEG)
        return fitted if all(self._carried_onto_itself(rotation) for rotation in rotations) else None

    def rotations_about(self, axis: np.ndarray) -> list[np.ndarray]:
        """All turns [4, 4] (metres) about an axis by 360°/n and its multiples, for the largest n that fits.

        A slim shape misses itself by little after any turn about its long axis; so a turn must also miss by clearly
        less than those that are no symmetry.
        """
        other = max(self._misses(_about(axis, np.radians(degrees)), self._turned)[0] for degrees in _PROBE_ANGLES_DEG)
        for order in range(LARGEST_ORDER, 1, -1):
            fitted = self._fitted(axis, 2 * np.pi / order)
            if fitted is None:
                continue
            if self._carried_onto_itself(_about(fitted, 2 * np.pi / order), _CLEARLY_LESS * other):
                return [self.in_metres(_about(fitted, 2 * np.pi * k / order)) for k in range(1, order)]
        return []

    def clear_ones(self, rotations: list[np.ndarray]) -> list[np.ndarray]:
        """The rotations whose residual is near the smallest one: noise affects all symmetries of a surface alike."""
        misses = np.array([self._misses(rotation[:3, :3], self._turned)[0] for rotation in rotations])
        limit = max(_NOISE, _SHARED_NOISE * misses.min(initial=np.inf))
        return [rotation for rotation, miss in zip(rotations, misses, strict=True) if miss <= limit]

    def _fitted(self, axis: np.ndarray, angle: float) -> np.ndarray | None:
        """The axis near the given one about which that turn fits best (iterated closest points), or None.

        The centroid stays where it is under any symmetry, so the axis passes through it and only its direction is
        sought.
        """
        rotation = _about(axis, angle)
        if self._misses(rotation, self._few)[0] > _COARSE * TOLERANCE:
            return None
        some = self._turned[::3]
        for _ in range(_FIT_STEPS):
            nearest, distances = self._nearest(some @ rotation.T)
            close = distances < _COARSE * TOLERANCE
            rotation = Rotation.align_vectors(nearest[close], some[close])[0].as_matrix()
        vector = Rotation.from_matrix(rotation).as_rotvec()
        found = float(np.linalg.norm(vector))
        if np.degrees(abs(found - angle)) > _DRIFT_DEG:
            return None
        return vector / found if vector @ axis > 0 else -vector / found

    def _carried_onto_itself(self, rotation: np.ndarray, tolerance: float = TOLERANCE) -> bool:
        typical, largest = self._misses(rotation, self._turned)
        return typical < min(tolerance, TOLERANCE) and largest < LARGEST_MISS

    def _misses(self, rotation: np.ndarray, points: np.ndarray) -> tuple[float, float]:
        """95th percentile and maximum of how far turned points lie from the surface."""
        _, distances = self._nearest(points @ rotation.T)
        return float(np.percentile(distances, 95)), float(distances.max())

    def _nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The surface's nearest points [n, 3], on the triangles of the three nearest samples, and their distances."""
        _, samples = self._tree.query(points, k=3)
        triangles = self._triangles[samples].reshape(-1, 3, 3)
        found = trimesh.triangles.closest_point(triangles, np.repeat(points, 3, axis=0)).reshape(-1, 3, 3)
        distances = np.linalg.norm(found - points[:, None], axis=2)
        best = distances.argmin(axis=1)[:, None]
        nearest = np.take_along_axis(found, best[..., None], axis=1)[:, 0]
        return nearest, np.take_along_axis(distances, best, axis=1)[:, 0]

    def in_metres(self, rotation: np.ndarray) -> np.ndarray:
        """A turn [3, 3] about the centre, as a motion [4, 4] of the object frame."""
        result = np.eye(4)
        result[:3, :3], result[:3, 3] = rotation, self.centre - rotation @ self.centre
        return result


def _second_moments(triangles: np.ndarray) -> np.ndarray:
    """Integral of the points' outer products over a surface, [3, 3]; exact, where samples turn axes by degrees.

    Args:
        triangles: [n, 3, 3], the origin at the surface's centroid.
    """
    areas = trimesh.triangles.area(triangles)
    sums = triangles.sum(axis=1)
    products = np.einsum("nci,ncj->nij", triangles, triangles) + sums[:, :, None] * sums[:, None]
    moments: np.ndarray = (areas[:, None, None] * products).sum(axis=0) / 12
    return moments


def _about(axis: np.ndarray, angle: float) -> np.ndarray:
    matrix: np.ndarray = Rotation.from_rotvec(axis * angle).as_matrix()
    return matrix


def _hemisphere(count: int) -> np.ndarray:
    """Directions [count, 3] spread evenly over a half sphere (a Fibonacci lattice)."""
    number = np.arange(count)
    height = (number + 0.5) / count
    azimuth = number * np.pi * (3 - np.sqrt(5))
    level = np.sqrt(1 - height**2)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), height], axis=1)


def _same_line(a: np.ndarray, b: np.ndarray, within_deg: float) -> bool:
    """Whether two axes are one; an axis and its negative are."""
    return bool(abs(a @ b) > np.cos(np.radians(within_deg)))


def _is_known(rotation: np.ndarray, known: list[np.ndarray]) -> bool:
    return any(
        np.degrees(Rotation.from_matrix(rotation[:3, :3].T @ other[:3, :3]).magnitude()) < _SAME_DEG for other in known
    )
