"""The static Mitsuba scene: every kind of object once, at unit size, far from the others; built once, traced for ever.

A rigid object seen by a camera is the camera seen from the object, so meshes never move; rays do. Each mesh is moved
to its bounding sphere's centre, scaled to unit radius and shifted to a place of its own, which keeps float32 at its
best whatever the object's size.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from curio_train.errors import RendererError
from curio_train.meshes.meshes import Mesh
from curio_train.rendering.bounds import enclosing_polytope
from curio_train.rendering.silhouette_edges import EdgeTable, build_edges
from curio_train.rendering.topology import Adjacency, adjacency, smooth_normals

SPACING = 4.0  # of bounding spheres of radius 1
NUM_CORNERS = 80  # simple polytopes of 42 sides have 2 · 42 − 4


@dataclass(frozen=True)
class Placement:
    """Position of a kind of object in the static scene: ``scene = (object − center) / radius + offset``.

    ``corners_m`` [n, 3] are those of a polytope around it, object frame, repeated to the same number for every kind.
    """

    center_m: np.ndarray
    radius_m: float
    offset: np.ndarray
    corners_m: np.ndarray


@dataclass(frozen=True)
class StaticScene:
    """The static scene that the renderer traces: every kind of object once, side by side."""

    scene: Any
    """The ``mitsuba.Scene``."""
    placements: tuple[Placement, ...]
    """One a kind."""
    edges: EdgeTable
    """Silhouette candidates of all kinds, in scene coordinates."""


def location(meshes: Sequence[Mesh]) -> tuple[Placement, ...]:
    """Unit size and a place of its own for each mesh."""
    placements = []
    for kind, mesh in enumerate(meshes):
        used = mesh.vertices_m[np.unique(mesh.faces)]
        center = (used.min(0) + used.max(0)) / 2
        radius = float(np.linalg.norm(used - center, axis=1).max())
        if not np.isfinite(radius) or radius <= 0:
            raise RendererError(f"mesh {kind} has no extent (radius {radius}); it cannot be rendered")
        corners = np.resize(enclosing_polytope((used - center) / radius), (NUM_CORNERS, 3)) * radius + center
        placements.append(Placement(center, radius, np.array([SPACING * kind, 0.0, 0.0]), corners))
    return tuple(placements)


def build_scene(mitsuba: Any, meshes: Sequence[Mesh]) -> StaticScene:
    """Load all meshes into one scene.

    Raises:
        RendererError: There is no mesh, or one without extent.
    """
    if not meshes:
        raise RendererError("no mesh to render")
    placements = location(meshes)
    shapes, edges = {}, []
    for kind, (mesh, placement) in enumerate(zip(meshes, placements, strict=True)):
        unit = (mesh.vertices_m - placement.center_m) / placement.radius_m
        neighbours = adjacency(unit, mesh.faces)
        if len(neighbours.faces) == 0:
            raise RendererError(f"mesh {kind} has no face with an area; it cannot be rendered")
        shapes[f"kind_{kind}"] = mesh_shape(mitsuba, f"kind_{kind}", mesh, unit + placement.offset, neighbours)
        edges.append((unit + placement.offset, neighbours))
    scene = mitsuba.load_dict({"type": "scene", **shapes})
    return StaticScene(scene, placements, build_edges(edges))


def mesh_shape(
    mitsuba: Any,
    name: str,
    mesh: Mesh,
    vertices: np.ndarray,
    neighbours: Adjacency,
    tint: np.ndarray | tuple[float, float, float] = (1.0, 1.0, 1.0),
    opacity: float | None = None,
) -> Any:
    """A ``mitsuba.Mesh`` with smooth normals between folds and a diffuse BSDF of the mesh's own colours.

    Args:
        mitsuba: The module.
        name: Of the shape.
        mesh: Faces and colours.
        vertices: [v, 3], where the mesh's vertices stand in the scene.
        neighbours: Its edges.
        tint: Linear albedo that multiplies the mesh's own.
        opacity: Of both sides of the surface; None: solid, from outside.
    """
    source, faces, normals = smooth_normals(vertices, neighbours)
    uv = mesh.uv if mesh.texture is not None else None
    colors = mesh.vertex_colors_srgb if uv is None else None
    properties = mitsuba.Properties()
    reflectance = _reflectance(mitsuba, mesh, np.asarray(tint, dtype=np.float32))
    material: dict[str, Any] = {"type": "diffuse", "reflectance": reflectance}
    if opacity is not None:
        material = {"type": "mask", "opacity": opacity, "surface": {"type": "twosided", "material": material}}
    properties["bsdf"] = mitsuba.load_dict(material)
    shape = mitsuba.Mesh(
        name,
        vertex_count=len(source),
        face_count=len(faces),
        has_vertex_normals=True,
        has_vertex_texcoords=uv is not None,
        props=properties,
    )
    if colors is not None:
        shape.add_attribute("vertex_color", 3, _flat(linear_from_srgb(colors[source]) * tint))
    parameters = mitsuba.traverse(shape)
    parameters["vertex_positions"] = _flat(vertices[source])
    parameters["faces"] = np.ascontiguousarray(faces, dtype=np.uint32).ravel()
    parameters["vertex_normals"] = _flat(normals)
    if uv is not None:
        # Mitsuba counts v from the upper edge.
        parameters["vertex_texcoords"] = _flat(uv[source] * [1, -1] + [0, 1])
    parameters.update()
    return shape


def _reflectance(mitsuba: Any, mesh: Mesh, tint: np.ndarray) -> dict[str, Any]:
    if mesh.texture is not None and mesh.uv is not None:
        linear = mitsuba.Bitmap(np.ascontiguousarray(linear_from_srgb(mesh.texture.astype(np.float32) / 255) * tint))
        return {"type": "bitmap", "bitmap": linear, "raw": True}
    if mesh.vertex_colors_srgb is not None:
        return {"type": "mesh_attribute", "name": "vertex_color"}
    return {"type": "rgb", "value": [float(v) for v in tint]}


def _flat(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=np.float32).ravel()


def linear_from_srgb(srgb: np.ndarray) -> np.ndarray:
    """Decode sRGB (IEC 61966-2-1) in [0, 1] to linear light."""
    srgb = np.asarray(srgb, dtype=np.float32)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4).astype(np.float32)
