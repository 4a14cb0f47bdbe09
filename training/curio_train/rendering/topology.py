"""Which faces meet at which edges, where a surface folds, and the smooth normals between the folds (numpy)."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

CREASE_DEG = 30.0
"""Faces that meet at a larger angle are shaded apart, with a fold in between, as in CAD viewers."""

SLIVER = 5e-4
"""Height of a face by its longest side at which float32 no longer knows where on it a point is: Mitsuba interpolates
colours there as 0/0, and one such pixel ends a training."""


@dataclass(frozen=True)
class Adjacency:
    """Edges of a mesh, vertices in the same place taken as one, faces without area and slivers left out."""

    faces: np.ndarray
    """Int [f, 3], the other faces."""
    face_normals: np.ndarray
    """[f, 3], unit length."""
    first: np.ndarray
    """Int [e], half-edge (3 · face + corner, from that corner to the next) of one face at each edge."""
    second: np.ndarray
    """Int [e], half-edge of another face; meaningless where not ``paired``."""
    paired: np.ndarray
    """Bool [e], exactly two faces meet."""
    sign: np.ndarray
    """[e], −1 where the two are wound against each other."""
    cosine: np.ndarray
    """[e], between the two normals (after ``sign``)."""

    @property
    def crease(self) -> np.ndarray:
        """Whether the surface folds at each edge, bool [e]."""
        return self.paired & (self.cosine < np.cos(np.radians(CREASE_DEG)))

    @property
    def closed(self) -> bool:
        """Whether the surface has an inside: two faces at every edge, wound alike."""
        return bool(self.paired.all() and (self.sign > 0).all())


def adjacency(vertices: np.ndarray, faces: np.ndarray) -> Adjacency:
    """Find the edges of a mesh given as vertices [v, 3] of about unit size and faces [f, 3]."""
    faces = np.asarray(faces, dtype=np.int64)
    _, merged = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)
    corners = np.asarray(vertices, dtype=np.float64)[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    longest = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1)
    solid = area > np.maximum(1e-14, SLIVER * longest**2)
    faces, normals = faces[solid], normals[solid] / area[solid, None]
    ends = merged.reshape(-1)[np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)]
    forward = ends[:, 0] < ends[:, 1]
    low, high = ends.min(1), ends.max(1)
    order = np.lexsort((high, low))
    changes = (np.diff(low[order]) != 0) | (np.diff(high[order]) != 0)
    start = np.flatnonzero(np.r_[True, changes]) if len(order) else np.zeros(0, dtype=np.int64)
    paired = np.diff(np.r_[start, len(order)]) == 2
    first, second = order[start], order[np.minimum(start + 1, len(order) - 1)]
    sign = np.where(forward[first] == forward[second], -1.0, 1.0)
    cosine = (normals[first // 3] * normals[second // 3]).sum(1) * sign
    return Adjacency(faces, normals, first, second, paired, sign, np.clip(cosine, -1, 1))


def smooth_normals(vertices: np.ndarray, mesh: Adjacency) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split vertices at folds and give each piece the angle-weighted mean normal of its faces.

    Where neighbours are wound against each other, each face sees the mean from its own side.

    Returns:
        source: int [v'], the original vertex of each new one; faces: int [f, 3]; normals: [v', 3], unit length.
    """
    piece = _smooth_pieces(mesh)
    weighted = mesh.face_normals.repeat(3, axis=0) * _corner_angles(vertices, mesh.faces).reshape(-1, 1)
    if len(piece) > len(weighted):
        weighted = np.concatenate([weighted, -weighted])
    sums = np.stack([np.bincount(piece, weights=weighted[:, i]) for i in range(3)], axis=1)
    pair = np.stack([piece[: mesh.faces.size], mesh.faces.ravel()], axis=1)
    unique, first, corner = np.unique(pair, axis=0, return_index=True, return_inverse=True)
    normals = sums[unique[:, 0]]
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    # Faces on both sides of one sheet cancel out: there each has its own normal.
    own = mesh.face_normals[first // 3]
    normals = np.where(length > 1e-9, normals / np.maximum(length, 1e-12), own)
    return unique[:, 1], corner.reshape(-1, 3), normals


def _smooth_pieces(mesh: Adjacency) -> np.ndarray:
    """Number of the smooth piece that each face corner belongs to, [3 f].

    Where any neighbours are wound against each other, [6 f]: a second copy of all corners stands for their other side.
    """
    smooth = mesh.paired & ~mesh.crease
    first, second, same_way = mesh.first[smooth], mesh.second[smooth], mesh.sign[smooth] > 0
    # A face passes the edge from one corner to its next; a neighbour wound alike passes it the other way round.
    start = np.where(same_way, _next(second), second)
    end = np.where(same_way, second, _next(second))
    size = mesh.faces.size
    joins = np.stack([np.r_[first, _next(first)], np.r_[start, end]])
    if not same_way.all():
        across = np.tile(np.where(same_way, 0, size), 2)
        joins = np.concatenate(
            [joins + [[0], [1]] * across, joins + np.stack([0 * across + size, size - across])], axis=1
        )
        size *= 2
    graph = coo_matrix((np.ones(joins.shape[1], dtype=np.int8), joins), shape=(size, size))
    return np.asarray(connected_components(graph, directed=False)[1])


def _next(half_edge: np.ndarray) -> np.ndarray:
    return half_edge - half_edge % 3 + (half_edge + 1) % 3


def _corner_angles(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corners = np.asarray(vertices, dtype=np.float64)[faces]
    to_next = np.roll(corners, -1, axis=1) - corners
    to_last = np.roll(corners, 1, axis=1) - corners
    cross = np.linalg.norm(np.cross(to_next, to_last), axis=2)
    return np.arctan2(cross, (to_next * to_last).sum(2))
