"""Meshes with fewer faces that look the same: what is smaller than a pixel cannot be seen, but costs time to trace.

Edges are collapsed where the surface bends least (Garland and Heckbert 1997, by fast-simplification); colours and
texture coordinates are those of the nearest points on the original surface.
"""

import dataclasses
from dataclasses import dataclass

import fast_simplification
import numpy as np
import trimesh
from scipy.spatial import KDTree

from curio_train.meshes.meshes import Mesh

_WORTH_IT = 2
_SAMPLES_A_FACE = 4  # of the simpler mesh: on large faces, points lie closer together than its vertices
_NUM_NEAREST = 8
_TORN = 1 / 6
"""Share of a face's texture coordinates' spread by which their mean misses the face's centre at a seam.

There the mean lies a third of the seam's jump away from either side; elsewhere both agree.
"""
_NUM_CHECKED, _LOST_SHARE = 4096, 0.01


def simplified(mesh: Mesh, max_faces: int) -> Mesh:
    """A mesh of about ``max_faces`` faces that looks the same in an image of as many pixels, or the mesh itself.

    It is the mesh itself where that has up to twice as many faces, and where simplifying would lose parts: where more
    than 1 % of the surface would be off by more than half a pixel if the object filled the image, as with loose leaves.
    Vertices in the same place are taken as one, so that no seam opens. The result keeps the ``sha256`` of the original.

    Args:
        mesh: Any; borders, faces without area and odd winding are no obstacle.
        max_faces: Some more may be left where further collapses would turn faces over.
    """
    if len(mesh.faces) <= _WORTH_IT * max_faces:
        return mesh
    low, high = mesh.vertices_m.min(0), mesh.vertices_m.max(0)
    # In pixels of an image that the object fills: the library's first thresholds are then thousandths of a pixel.
    center, pixel_m = (low + high) / 2, float((high - low).max()) / np.sqrt(max_faces)
    welded, faces = _weld((mesh.vertices_m - center) / pixel_m, mesh.faces)
    vertices, faces = fast_simplification.simplify(welded, faces, target_count=max_faces)
    simpler = dataclasses.replace(
        mesh, vertices_m=vertices * pixel_m + center, faces=faces.astype(np.int64), vertex_colors_srgb=None, uv=None
    )
    if len(faces) == 0 or _loses_parts(mesh, simpler, tolerance_m=0.5 * pixel_m):
        return mesh
    return _dressed(simpler, mesh)


def _weld(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices in different places, and the faces that keep three of them."""
    places, merged = np.unique(np.round(vertices, 5), axis=0, return_inverse=True)
    faces = merged.reshape(-1)[faces]
    solid = (faces != np.roll(faces, 1, axis=1)).all(1)
    return places, faces[solid]


@dataclass(frozen=True)
class _Points:
    """On a mesh's surface: distances [n] from what was asked for, faces [n] and barycentric coordinates [n, 3]."""

    distance_m: np.ndarray
    face: np.ndarray
    weights: np.ndarray

    def interpolate(self, mesh: Mesh, values: np.ndarray) -> np.ndarray:
        """Values [v, k] of the vertices at the points, [n, k]."""
        return np.asarray(np.einsum("nc,nck->nk", self.weights, values[mesh.faces[self.face]]))


class _Surface:
    """Finds points of a surface, by the nearest of many that are spread over it."""

    def __init__(self, mesh: Mesh, num_samples: int) -> None:
        """Spread them over the faces' centres and, for the sake of large faces, ``num_samples`` evenly."""
        self._triangles = mesh.vertices_m[mesh.faces]
        self._per_m = np.sqrt(len(mesh.faces)) / np.ptp(mesh.vertices_m, axis=0).max()  # about one a face's width
        even, face = _even(mesh, num_samples)
        self._face = np.r_[np.arange(len(mesh.faces)), face]
        self._tree = KDTree(np.concatenate([self._triangles.mean(1), even]))

    def nearest(self, points_m: np.ndarray) -> _Points:
        """The surface's nearest points to ``points_m`` [n, 3]."""
        face = self._face[self._tree.query(points_m, k=_NUM_NEAREST)[1]]
        # Trimesh takes what is tiny for zero, and faces in metres are.
        triangles, points = self._triangles[face.ravel()] * self._per_m, points_m * self._per_m
        closest = trimesh.triangles.closest_point(triangles, np.repeat(points, _NUM_NEAREST, axis=0))
        distance_m = np.linalg.norm(closest.reshape(*face.shape, 3) - points[:, None], axis=2) / self._per_m
        best = np.ravel_multi_index((np.arange(len(face)), distance_m.argmin(1)), face.shape)
        weights = trimesh.triangles.points_to_barycentric(triangles[best], closest[best], method="cross")
        flat = ~np.isfinite(weights).all(1)  # on a face without area
        weights = np.where(flat[:, None], 1 / 3, np.clip(weights, 0, 1))
        return _Points(distance_m.min(1), face.ravel()[best], weights)


def _even(mesh: Mesh, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points [count, 3] by area, and their faces."""
    whole = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
    points_m, face = trimesh.sample.sample_surface(whole, count, seed=0)
    return np.asarray(points_m), np.asarray(face)


def _loses_parts(mesh: Mesh, simpler: Mesh, tolerance_m: float) -> bool:
    points_m, _ = _even(mesh, _NUM_CHECKED)
    surface = _Surface(simpler, _SAMPLES_A_FACE * len(simpler.faces))
    return bool((surface.nearest(points_m).distance_m > tolerance_m).mean() > _LOST_SHARE)


def _dressed(simpler: Mesh, mesh: Mesh) -> Mesh:
    """The simpler mesh in the colours of the other."""
    num_samples = _SAMPLES_A_FACE * len(simpler.faces)
    if mesh.texture is not None and mesh.uv is not None:
        corners_m = simpler.vertices_m[simpler.faces]
        vertices_m, faces = corners_m.reshape(-1, 3), np.arange(simpler.faces.size).reshape(-1, 3)
        uv = _texture_coordinates(mesh, mesh.uv, corners_m, _Surface(mesh, num_samples))
        return dataclasses.replace(simpler, vertices_m=vertices_m, faces=faces, uv=uv)
    if mesh.vertex_colors_srgb is not None:
        points = _Surface(mesh, num_samples).nearest(simpler.vertices_m)
        return dataclasses.replace(simpler, vertex_colors_srgb=points.interpolate(mesh, mesh.vertex_colors_srgb))
    return simpler


def _texture_coordinates(mesh: Mesh, uv: np.ndarray, corners_m: np.ndarray, surface: _Surface) -> np.ndarray:
    """[3 f, 2] for the corners [f, 3, 3] of faces; a face across a seam shows the colour of its centre."""
    found = surface.nearest(corners_m.reshape(-1, 3)).interpolate(mesh, uv).reshape(-1, 3, 2)
    center = surface.nearest(corners_m.mean(1)).interpolate(mesh, uv)
    torn = np.abs(found.mean(1) - center).max(1) > _TORN * np.ptp(found, axis=1).max(1)
    found[torn] = center[torn, None]
    return found.reshape(-1, 2)
