"""Examines a mesh file: whether it can be read, its unit, size, colours, symmetries and surface."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from curio_train.doctor.finding import Finding, Sureness
from curio_train.errors import CurioError
from curio_train.meshes.cad import CAD_SUFFIXES, named
from curio_train.meshes.meshes import METRES, Mesh, Unit, load_mesh
from curio_train.meshes.symmetries import Symmetries, find_symmetries

# What people hold before a camera; outside it a unit was probably mistaken, though such things exist.
_USUAL_M = (0.01, 3.0)
_MOST_FACES = 500_000


def examine_mesh(path: Path, unit: Unit | None, body: str | None = None) -> tuple[Mesh | None, list[Finding]]:
    """The mesh, where it can be trained on, and everything remarkable about it."""
    try:
        mesh = load_mesh(path, unit, body)
    except CurioError as exc:
        fault = "mesh size" if "found a diameter" in str(exc) else "mesh unreadable"
        return None, [Finding("mesh", "bad", str(exc), fault=fault)]
    extent = " x ".join(f"{size * 1000:.4g}" for size in np.ptp(mesh.vertices_m, axis=0))
    text = f"{path}: {len(mesh.faces):,} faces, {extent} mm, diameter {mesh.diameter_m * 1000:.4g} mm"
    findings = [Finding("mesh", "good", text), *_bodies(mesh), *_size(mesh, path, unit), *_colours(mesh)]
    surface = list(examine_surface(mesh))
    if any(finding.fault == "stray parts" for finding in surface):
        return mesh, [*findings, *surface]  # its diameter is not the object's, and every tolerance is a fraction of it
    return mesh, [*findings, *surface, _symmetries(find_symmetries(mesh))]


def _bodies(mesh: Mesh) -> Iterator[Finding]:
    if len(mesh.bodies) > 1:
        text = f"{len(mesh.bodies)} bodies were merged into one object: {named(mesh.bodies)}"
        remedy = "If the object is only one of them, name it with --body"
        yield Finding("mesh bodies", "warning", text, remedy, "possible", fault="several bodies")


def _size(mesh: Mesh, path: Path, unit: Unit | None) -> Iterator[Finding]:
    low, high = _USUAL_M
    if len(mesh.faces) > _MOST_FACES:
        text = f"{len(mesh.faces):,} faces, more than rendering in small images can show"
        yield Finding("mesh size", "warning", text, f"Reduce it to {_MOST_FACES:,} or fewer", fault="mesh size")
    if low <= mesh.diameter_m <= high:
        return
    in_file = mesh.diameter_m / METRES[unit or "m"]
    others = [
        f"--mesh-unit {name} (diameter {in_file * metres * 1000:.4g} mm)"
        for name, metres in METRES.items()
        if name != (unit or "m") and low <= in_file * metres <= high
    ]
    text = f"a diameter of {mesh.diameter_m * 1000:.4g} mm is unusual; the unit may be another"
    remedy = f"If it is not the object's true size, set {' or '.join(others)}" if others else "Check the file's unit"
    if path.suffix.lower() in CAD_SUFFIXES:  # it says its unit, and --mesh-unit is refused
        remedy = "If it is not the object's true size, export it again in its true unit"
    yield Finding("mesh unit", "warning", text, remedy, "likely" if others else "possible", fault="mesh unit")


def _colours(mesh: Mesh) -> Iterator[Finding]:
    if mesh.texture is None and mesh.vertex_colors_srgb is None:
        text = "no colours: it will be rendered in one colour"
        yield Finding(
            "mesh colours",
            "warning",
            text,
            "Export it with vertex colours or a texture, if it has any",
            fault="no colour",
        )
        return
    kind = "a texture" if mesh.texture is not None else "vertex colours"
    yield Finding("mesh colours", "good", f"it has {kind}")


def _symmetries(found: Symmetries) -> Finding:
    """Reports symmetries, which are no fault."""
    parts = [f"{len(found.discrete)} discrete"] * bool(found.discrete)
    for axis, _ in found.continuous:
        parts.append("any turn about (" + ", ".join(f"{value:.2f}" for value in axis) + ")")
    if not parts:
        return Finding("mesh symmetries", "good", "the shape has none")
    text = f"the shape has symmetries: {' and '.join(parts)}; poses that differ by them look the same without paint"
    return Finding("mesh symmetries", "good", text)


# Scanned meshes in daily use have a few of each (up to 0.1 %); one in a hundred is somebody's mistake.
_FEW = 0.01
_LARGEST_HOLE = 0.003  # of the surface's area
_CLEARLY_INWARD = 0.01  # of the box: an open sheet encloses next to nothing, in either direction
_SMALL_PART, _FAR_OUT = 0.02, 1.5  # a stray part has few of the faces, and lets the object seem that much larger


def examine_surface(mesh: Mesh) -> Iterator[Finding]:
    """Finds faults of the mesh's triangles."""
    shape = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
    shape.merge_vertices(merge_tex=True, merge_norm=True)  # a seam of the texture is no hole
    yield from _useless_faces(shape)
    yield from _edges(shape)
    yield from _inside_out(shape)
    yield from _stray_parts(shape)


def _useless_faces(shape: trimesh.Trimesh) -> Iterator[Finding]:
    flat = float((shape.area_faces < 1e-12 * shape.area).mean())
    repeated = 1 - len(np.unique(np.sort(shape.faces, axis=1), axis=0)) / len(shape.faces)
    if max(flat, repeated) > _FEW:
        text = f"{flat:.1%} of the faces have no area, {repeated:.1%} occur twice"
        yield Finding(
            "mesh faces",
            "warning",
            text,
            "Clean the mesh (remove degenerate and duplicate faces)",
            fault="degenerate faces",
        )


def _edges(shape: trimesh.Trimesh) -> Iterator[Finding]:
    edges, numbers, counts = np.unique(shape.edges_sorted, axis=0, return_inverse=True, return_counts=True)
    crowded = float((counts > 2).mean())
    if crowded > _FEW:
        text = f"{crowded:.1%} of the edges belong to more than two faces: there are walls inside, or faces that repeat"
        yield Finding(
            "mesh edges", "warning", text, "Make it one closed surface (union of its parts)", fault="non-manifold"
        )
    directed = len(np.unique(shape.edges, axis=0))
    turned = (len(shape.edges) - directed) / len(edges)
    if turned > _FEW and crowded <= _FEW:
        text = f"neighbouring faces disagree at {turned:.1%} of the edges about which side is out"
        yield Finding("mesh orientation", "warning", text, "Recalculate the normals", fault="mixed orientation")
    area = _largest_hole(shape, counts[numbers.ravel()] == 1)
    if area > _LARGEST_HOLE * shape.area:
        text = f"it has a hole as large as {area / shape.area:.1%} of its surface; its inside will be seen through it"
        yield Finding(
            "mesh holes", "warning", text, "Close it, unless the object is open there", "likely", fault="holes"
        )


def _largest_hole(shape: trimesh.Trimesh, is_open: np.ndarray) -> float:
    """Area of the largest hole: half the sum of the cross products round its border, whichever edge comes first."""
    border = shape.edges[is_open]
    if len(border) == 0:
        return 0.0
    count = len(shape.vertices)
    links = coo_matrix((np.ones(len(border)), (border[:, 0], border[:, 1])), shape=(count, count))
    _, labels = connected_components(links, directed=False)
    points = shape.vertices - shape.vertices.mean(axis=0)
    cross = np.cross(points[border[:, 0]], points[border[:, 1]]) / 2
    loop = labels[border[:, 0]]
    sums = np.stack([np.bincount(loop, weights=cross[:, axis]) for axis in range(3)], axis=1)
    return float(np.linalg.norm(sums, axis=1).max())


def _inside_out(shape: trimesh.Trimesh) -> Iterator[Finding]:
    """The signed volume is negative where faces point inwards."""
    corners = shape.triangles - shape.centroid
    volume = float(np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6)
    box = float(np.prod(np.ptp(shape.vertices, axis=0)))
    if volume < -_CLEARLY_INWARD * box:
        sure: Sureness = "certain" if shape.is_watertight else "likely"
        text = "its faces point inwards: it is inside out, and light would come from the wrong side"
        yield Finding("mesh orientation", "bad", text, "Flip the normals", sure, fault="inside out")


def _stray_parts(shape: trimesh.Trimesh) -> Iterator[Finding]:
    """Small parts far away, as left behind in a scene or a scan: they make box and diameter useless."""
    count, labels = connected_components(
        coo_matrix((np.ones(len(shape.edges)), shape.edges.T), shape=(len(shape.vertices),) * 2), directed=False
    )
    if count == 1:
        return
    label_of_face = labels[shape.faces[:, 0]]
    main = shape.faces[label_of_face == np.bincount(label_of_face).argmax()]
    if len(main) < (1 - _SMALL_PART) * len(shape.faces):
        return
    whole = np.linalg.norm(np.ptp(shape.vertices, axis=0))
    alone = np.linalg.norm(np.ptp(shape.vertices[np.unique(main)], axis=0))
    if whole > _FAR_OUT * alone:
        text = f"{count - 1} small parts lie apart: with them it is {whole / alone:.1f} times as large as without"
        yield Finding(
            "mesh parts",
            "warning",
            text,
            "Remove them if they are no part of the object",
            "likely",
            fault="stray parts",
        )
