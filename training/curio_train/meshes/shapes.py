"""Shapes that need no file. Centred at the origin, in metres; round ones stand along y, which is up in the worlds."""

import hashlib
from dataclasses import replace
from typing import Any

import numpy as np
import trimesh

from curio_train.meshes.meshes import Mesh


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


def chair(height_m: float) -> Mesh:
    """A chair of six boxes that overlap: seat, back rest at its rear edge (-z), four legs; the sitter looks along +z.

    It is as high as given, half as wide and half as deep; the origin is its middle.
    """
    half, leg, thick = 0.25, 0.04, 0.03
    parts = [
        ((0.0, 0.0, 0.0), (2 * half, 2 * thick, 2 * half)),
        ((0.0, 0.25, thick - half), (2 * half, 0.5, 2 * thick)),
    ]
    parts += [
        ((x, -0.25, z), (2 * leg, 0.5, 2 * leg)) for x in (leg - half, half - leg) for z in (leg - half, half - leg)
    ]
    pieces = []
    for center, extents in parts:
        piece = trimesh.creation.box(extents=np.array(extents) * height_m)
        piece.apply_translation(np.array(center) * height_m)
        pieces.append(piece)
    return _as_mesh(trimesh.util.concatenate(pieces))


def standing(mesh: Mesh) -> Mesh:
    """The mesh with its lowest point at y = 0, so that its origin touches the ground."""
    return replace(mesh, vertices_m=mesh.vertices_m - [0.0, mesh.vertices_m[:, 1].min(), 0.0], sha256="")


def painted(mesh: Mesh, darkest: float) -> Mesh:
    """The mesh in greys that fade from white at its front (+z) to ``darkest`` (sRGB) at its back.

    Capsules and cones look alike from all sides; paint makes their yaw something that can be seen.
    """
    z = mesh.vertices_m[:, 2]
    share = (z - z.min()) / (z.max() - z.min())
    grey = np.repeat((darkest + share * (1 - darkest))[:, None], 3, axis=1)
    content = (mesh.sha256 + grey.astype("<f8").tobytes().hex()).encode()
    return replace(mesh, vertex_colors_srgb=grey, sha256=hashlib.sha256(content).hexdigest())
