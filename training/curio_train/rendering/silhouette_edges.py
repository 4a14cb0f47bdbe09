"""Silhouette candidates of a mesh: its edges with the two faces beside each, grouped for quick rejection (numpy).

An edge can be a silhouette where its two faces look to different sides of the camera, or where a face is missing; at a
fold, shading jumps too. Edges are grouped into clusters of like position and direction; a cluster whose faces all look
to one side of the camera is passed over as a whole, so the search does not grow as the number of faces does.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from curio_train.rendering.topology import Adjacency

CLUSTER_SIZE = 64


@dataclass(frozen=True)
class EdgeTable:
    """Edges of all kinds, cluster after cluster, kind after kind; scene coordinates.

    Attributes:
        start: float32 [edges, 3], one end.
        end: float32 [edges, 3], the other.
        normal_a: float32 [edges, 3], unit normal of one face; zero where the edge is always a candidate.
        normal_b: float32 [edges, 3], of the other.
        center: float32 [clusters, 3], of the sphere that holds the cluster's edges.
        radius: float32 [clusters].
        axis: float32 [clusters, 3], of the cone that holds the cluster's normals.
        angle: float32 [clusters], its half-angle in radians; π where the cluster may never be passed over.
        facing: float32 [clusters], how many faces of an edge must look at the camera: 1 or 2 at folds, where shading
            jumps too; 0 for exactly one.
        first_cluster: int64 [kinds + 1], where each kind's clusters begin.
    """

    start: np.ndarray
    end: np.ndarray
    normal_a: np.ndarray
    normal_b: np.ndarray
    center: np.ndarray
    radius: np.ndarray
    axis: np.ndarray
    angle: np.ndarray
    facing: np.ndarray
    first_cluster: np.ndarray


def build_edges(meshes: Sequence[tuple[np.ndarray, Adjacency]]) -> EdgeTable:
    """The table of several meshes, each given as vertices [v, 3] in the scene frame and its adjacency."""
    edges, clusters, counts = [], [], []
    for vertices, mesh in meshes:
        for quorum, table in _candidates(np.asarray(vertices, dtype=np.float64), mesh).items():
            table = _pad(table[_spatial_order(table)])
            edges.append(table)
            clusters.append((*_bound(table), np.full(len(table) // CLUSTER_SIZE, float(quorum))))
        counts.append(sum(len(table) for table in edges[-3:]) // CLUSTER_SIZE)
    flat = np.concatenate(edges).astype(np.float32)
    center, radius, axis, angle, facing = (np.concatenate(c).astype(np.float32) for c in zip(*clusters, strict=True))
    start, end, normal_a, normal_b = (np.ascontiguousarray(flat[:, i]) for i in range(4))
    first = np.concatenate([[0], np.cumsum(counts)])
    return EdgeTable(start, end, normal_a, normal_b, center, radius, axis, angle, facing, first)


def _candidates(vertices: np.ndarray, mesh: Adjacency) -> dict[int, np.ndarray]:
    """Edges by the number of their faces that must look at the camera, [edges, 4, 3]: both ends and both normals.

    0: exactly one face, or unknown: smooth surface and borders. 1: at least one: convex folds. 2: both: concave folds.
    """
    paired = mesh.paired[:, None]
    # Without an inside nobody can say which side of a fold looks away: such folds are always candidates.
    known = paired & (mesh.closed | ~mesh.crease[:, None])
    outward = -1.0 if mesh.closed and _signed_volume(vertices, mesh.faces) < 0 else 1.0
    normal_a = np.where(known, outward * mesh.face_normals[mesh.first // 3], 0.0)
    normal_b = np.where(known, outward * mesh.face_normals[mesh.second // 3] * mesh.sign[:, None], 0.0)
    corners = mesh.faces.ravel()
    ends = [vertices[corners[h]] for h in (mesh.first, mesh.first - mesh.first % 3 + (mesh.first + 1) % 3)]
    table = np.stack([*ends, normal_a, normal_b], axis=1)
    flat = mesh.paired & (mesh.cosine > 1 - 1e-12)
    # Where a closed surface bends inwards, the face that looks away hides the edge from whoever could see it.
    beyond = vertices[corners[mesh.second - mesh.second % 3 + (mesh.second + 2) % 3]] - ends[0]
    concave = mesh.closed & (np.einsum("ed,ed->e", normal_a, beyond) > 0)
    return {
        0: table[~flat & ~mesh.crease & ~concave],
        1: table[mesh.crease & ~concave],
        2: table[mesh.crease & concave],
    }


def _signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, i]] - vertices.mean(0) for i in range(3))
    return float(np.einsum("fi,fi->", a, np.cross(b, c)))


def _spatial_order(table: np.ndarray) -> np.ndarray:
    """An order in which runs of CLUSTER_SIZE edges are close in place and direction: median splits of a k-d tree."""
    features = np.concatenate([(table[:, 0] + table[:, 1]) / 2, 0.7 * (table[:, 2] + table[:, 3])], axis=1)
    order = np.arange(len(table))
    pieces = [(0, len(table))]
    while pieces:
        low, high = pieces.pop()
        if high - low <= CLUSTER_SIZE:
            continue
        part = features[order[low:high]]
        axis = int(np.argmax(np.ptp(part, axis=0)))
        half = -(-((high - low) // 2) // CLUSTER_SIZE) * CLUSTER_SIZE
        half = half if half < high - low else half - CLUSTER_SIZE
        order[low:high] = order[low:high][np.argpartition(part[:, axis], half)]
        pieces += [(low, low + half), (low + half, high)]
    return order


def _pad(table: np.ndarray) -> np.ndarray:
    """Fill the last cluster with copies of length zero, which are never sampled."""
    filler = np.repeat(table[-1:], -len(table) % CLUSTER_SIZE, axis=0)
    filler[:, 1] = filler[:, 0]
    return np.concatenate([table, filler])


def _bound(table: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    groups = table.reshape(-1, CLUSTER_SIZE, 4, 3)
    ends = groups[:, :, :2].reshape(len(groups), 2 * CLUSTER_SIZE, 3)
    center = (ends.min(1) + ends.max(1)) / 2
    radius = np.linalg.norm(ends - center[:, None], axis=2).max(1)
    normals = groups[:, :, 2:].reshape(len(groups), 2 * CLUSTER_SIZE, 3)
    mean = normals.sum(1)
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    axis = np.divide(mean, length, out=np.zeros_like(mean), where=length > 1e-9)
    cosine = np.einsum("gnd,gd->gn", normals, axis).min(1)
    always = (np.abs(normals).sum(2) == 0).any(1) | (length[:, 0] <= 1e-9)
    angle = np.where(always, np.pi, np.arccos(np.clip(cosine, -1, 1)) + 1e-3)
    return center, radius, axis, angle
