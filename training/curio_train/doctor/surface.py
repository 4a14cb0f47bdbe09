"""The surface of a mesh: which way it faces, holes, edges of more than two faces, faces without area, stray parts."""

from collections.abc import Iterator

import numpy as np
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from curio_train.doctor.finding import Finding, Sureness
from curio_train.meshes.meshes import Mesh

# Scanned meshes in daily use have a few of each (up to 0.1 %); one in a hundred is somebody's mistake.
_FEW = 0.01
_LARGEST_HOLE = 0.003  # of the surface's area
_CLEARLY_INWARD = 0.01  # of the box: an open sheet encloses next to nothing, in either direction
_SMALL_PART, _FAR_OUT = 0.02, 1.5  # a stray part has few of the faces, and lets the object seem that much larger


def examine_surface(mesh: Mesh) -> Iterator[Finding]:
    """What is wrong with the triangles."""
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
