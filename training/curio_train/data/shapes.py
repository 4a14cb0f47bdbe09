"""Shapes that need no file. Centred at the origin, in metres; round ones stand along y, which is up in the worlds."""

from typing import Any

import numpy as np
import trimesh

from curio_train.data.meshes import Mesh


def sphere(radius_m: float, subdivisions: int = 3) -> Mesh:
    """An icosphere: 20 * 4**subdivisions faces of nearly one size, vertices on the sphere."""
    return _as_mesh(trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius_m))


def box(extents_m: tuple[float, float, float]) -> Mesh:
    """A box of that width, height and depth (x, y, z): 12 faces."""
    return _as_mesh(trimesh.creation.box(extents=extents_m))


def cone(radius_m: float, height_m: float, sections: int = 32) -> Mesh:
    """A cone, tip upwards; the origin is half way up."""
    return _standing(trimesh.creation.cone(radius=radius_m, height=height_m, sections=sections))


def capsule(radius_m: float, height_m: float, sections: int = 32) -> Mesh:
    """A cylinder with half spheres on both ends; ``height_m`` is the whole height, at least twice the radius."""
    if height_m < 2 * radius_m:
        raise ValueError(f"a capsule of radius {radius_m} m cannot be {height_m} m high: at least {2 * radius_m} m")
    return _standing(
        trimesh.creation.capsule(radius=radius_m, height=height_m - 2 * radius_m, count=[sections, sections])
    )


def _standing(shape: Any) -> Mesh:
    """Turn z, along which trimesh builds, to y, and move the middle to the origin."""
    z_to_y = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    vertices = np.asarray(shape.vertices) @ z_to_y.T
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return Mesh(vertices - middle, np.asarray(shape.faces, dtype=np.int64))


def _as_mesh(shape: Any) -> Mesh:
    return Mesh(np.asarray(shape.vertices, dtype=np.float64), np.asarray(shape.faces, dtype=np.int64))
