"""The visibility term: moving outlines, by edge sampling (Li et al. 2018), the whole batch in a few launches.

∂I/∂θ at an outline is the jump of colour across it times the speed with which it moves along its normal. Silhouette
edges are found in scene space (two dot products an edge), sampled in proportion to their projected length, and the
image is composited a little to either side. A jump hidden behind another surface is no jump: occlusion, also by the
object itself, needs no further care.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from curio_train.rendering.edges import CLUSTER_SIZE, EdgeTable
from curio_train.rendering.layers import Rows

OFFSET_PX = 0.001
NEAR_M = 1e-3


@dataclass(frozen=True)
class OutlineSamples:
    """Points on outlines, ``num_samples`` a row, row after row.

    Attributes:
        row: Which object in which image.
        x, y: Position in pixels (K's convention: centres at integers).
        normal_x, normal_y: Unit normal of the outline in the image.
        weight: Length of outline that the sample stands for, pixels; 0 where the row has no outline.
        scene_point: The point on the edge, scene frame.
        camera_point: The same in the camera frame, metres.
    """

    row: Any
    x: Any
    y: Any
    normal_x: Any
    normal_y: Any
    weight: Any
    scene_point: Any
    camera_point: Any


class OutlineSampler:
    """Finds and samples the silhouette edges of all rows."""

    def __init__(self, mi: ModuleType, dr: ModuleType, edges: EdgeTable, kind_of_slot: Sequence[int]) -> None:
        self.mi, self.dr = mi, dr
        self.edges = {
            name: mi.Float(np.ascontiguousarray(getattr(edges, name)).ravel())
            for name in ("start", "end", "normal_a", "normal_b", "center", "radius", "axis", "angle", "fold")
        }
        pairs = [
            (slot, c)
            for slot, k in enumerate(kind_of_slot)
            for c in range(edges.first_cluster[k], edges.first_cluster[k + 1])
        ]
        self.slot_of_pair = mi.UInt32(np.array([p[0] for p in pairs], dtype=np.uint32))
        self.cluster_of_pair = mi.UInt32(np.array([p[1] for p in pairs], dtype=np.uint32))
        self.num_pairs, self.num_slots = len(pairs), len(kind_of_slot)

    def sample(self, rows: Rows, intrinsics: list[Any], jitter: np.ndarray) -> OutlineSamples | None:
        """Sample outlines in proportion to their length, stratified; None where no row has any.

        Args:
            rows: All rows, detached.
            intrinsics: fx, fy, cx, cy, one entry a row.
            jitter: float [rows, samples a row] in [0, 1).
        """
        mi, dr = self.mi, self.dr
        num_rows, num_samples = jitter.shape
        row, edge = self._silhouette_edges(rows, num_rows)
        if len(row) == 0:
            return None
        ends = [self._to_camera(rows, row, self._point(name, edge)) for name in ("start", "end")]
        length = self._projected_length(ends, [dr.gather(mi.Float, v, row) for v in intrinsics]).numpy()
        # The sums over a batch's edges are few; they are taken on the host, in double precision.
        total = np.cumsum(length, dtype=np.float64)
        border = np.searchsorted(row.numpy(), np.arange(num_rows + 1))
        before = np.r_[0.0, total][border]
        row_length = np.diff(before)
        target = before[:-1, None] + (np.arange(num_samples) + jitter) / num_samples * row_length[:, None]
        found = np.minimum(np.searchsorted(total, target.ravel(), side="right"), len(total) - 1)
        fraction = 1 - (total[found] - target.ravel()) / np.maximum(length[found], 1e-12)
        weight = np.repeat(row_length / num_samples, num_samples)
        return self._at(
            rows,
            mi.UInt32(np.repeat(np.arange(num_rows, dtype=np.uint32), num_samples)),
            mi.UInt32(edge.numpy()[found]),
            mi.Float(np.clip(fraction, 0, 1).astype(np.float32)),
            intrinsics,
            mi.Float(weight.astype(np.float32)),
        )

    def _silhouette_edges(self, rows: Rows, num_rows: int) -> tuple[Any, Any]:
        """(row, edge) of every silhouette edge, rows ascending."""
        mi, dr = self.mi, self.dr
        num_images = num_rows // self.num_slots
        lane = dr.arange(mi.UInt32, num_images * self.num_pairs)
        image = lane // self.num_pairs
        pair = lane - image * self.num_pairs
        row = image * self.num_slots + dr.gather(mi.UInt32, self.slot_of_pair, pair)
        cluster = dr.gather(mi.UInt32, self.cluster_of_pair, pair)
        kept = dr.compress(self._may_have_outline(rows, row, cluster))
        row, cluster = dr.gather(mi.UInt32, row, kept), dr.gather(mi.UInt32, cluster, kept)
        if len(row) == 0:
            return row, cluster
        dr.eval(row, cluster)
        lane = dr.arange(mi.UInt32, len(row) * CLUSTER_SIZE)
        source = lane // CLUSTER_SIZE
        row = dr.gather(mi.UInt32, row, source)
        edge = dr.gather(mi.UInt32, cluster, source) * CLUSTER_SIZE + (lane & (CLUSTER_SIZE - 1))
        kept = dr.compress(self._is_outline(rows, row, edge))
        row, edge = dr.gather(mi.UInt32, row, kept), dr.gather(mi.UInt32, edge, kept)
        dr.eval(row, edge)
        return row, edge

    def _may_have_outline(self, rows: Rows, row: Any, cluster: Any) -> Any:
        """False only where every face of the cluster surely looks to the same side of the camera."""
        mi, dr = self.mi, self.dr
        to_camera = self._origin(rows, row) - self._point("center", cluster)
        distance = dr.norm(to_camera)
        radius = dr.gather(mi.Float, self.edges["radius"], cluster)
        cosine = dr.dot(to_camera, self._point("axis", cluster)) / dr.maximum(distance, 1e-12)
        between = dr.acos(dr.clip(cosine, -1, 1))
        spread = dr.gather(mi.Float, self.edges["angle"], cluster) + dr.asin(
            dr.clip(radius / dr.maximum(distance, 1e-12), 0, 1)
        )
        beyond = between - dr.pi / 2
        fold = dr.gather(mi.Float, self.edges["fold"], cluster) > 0
        return dr.select(fold, beyond, dr.abs(beyond)) <= spread

    def _is_outline(self, rows: Rows, row: Any, edge: Any) -> Any:
        """Both sides of the camera, an open border, or a fold with a face towards the camera."""
        dr = self.dr
        to_camera = self._origin(rows, row) - self._point("start", edge)
        a, b = self._point("normal_a", edge), self._point("normal_b", edge)
        towards_a, towards_b = dr.dot(a, to_camera), dr.dot(b, to_camera)
        fold = dr.gather(self.mi.Float, self.edges["fold"], edge // CLUSTER_SIZE) > 0
        return (towards_a * towards_b <= 0) | (fold & (towards_a > 0))

    def _projected_length(self, ends: list[Any], intrinsics: list[Any]) -> Any:
        dr = self.dr
        visible = (ends[0].z > NEAR_M) & (ends[1].z > NEAR_M)
        pixels = [self._project(p, intrinsics) for p in ends]
        length = dr.hypot(pixels[1][0] - pixels[0][0], pixels[1][1] - pixels[0][1])
        return dr.select(visible & dr.isfinite(length), length, 0)

    def _at(self, rows: Rows, row: Any, edge: Any, fraction: Any, intrinsics: list[Any], weight: Any) -> OutlineSamples:
        mi, dr = self.mi, self.dr
        camera = [dr.gather(mi.Float, v, row) for v in intrinsics]
        ends = [self._point(name, edge) for name in ("start", "end")]
        in_camera = [self._to_camera(rows, row, p) for p in ends]
        (xa, ya), (xb, yb) = (self._project(p, camera) for p in in_camera)
        length = dr.maximum(dr.hypot(xb - xa, yb - ya), 1e-9)
        x, y = dr.lerp(xa, xb, fraction), dr.lerp(ya, yb, fraction)
        # Uniform along the projection is not uniform along the edge: undo the perspective.
        za, zb = in_camera[0].z, in_camera[1].z
        along = fraction * za / dr.maximum(dr.lerp(zb, za, fraction), 1e-9)
        scene_point = dr.lerp(ends[0], ends[1], along)
        return OutlineSamples(
            row,
            x,
            y,
            (ya - yb) / length,
            (xb - xa) / length,
            weight,
            scene_point,
            dr.lerp(in_camera[0], in_camera[1], along),
        )

    def _to_camera(self, rows: Rows, row: Any, point: Any) -> Any:
        """Scene to camera frame: p = matrix · q + origin with matrix = Rᵀ / s, hence q = s² matrixᵀ (p − origin)."""
        mi, dr = self.mi, self.dr
        m = [dr.gather(mi.Float, v, row) for v in rows.matrix]
        d = point - self._origin(rows, row)
        scale = 1 / (dr.square(m[0]) + dr.square(m[1]) + dr.square(m[2]))
        return scale * mi.Vector3f(*[m[i] * d.x + m[3 + i] * d.y + m[6 + i] * d.z for i in range(3)])

    def _origin(self, rows: Rows, row: Any) -> Any:
        return self.mi.Point3f(*[self.dr.gather(self.mi.Float, v, row) for v in rows.origin])

    def _point(self, name: str, index: Any) -> Any:
        return self.mi.Vector3f(*[self.dr.gather(self.mi.Float, self.edges[name], index * 3 + i) for i in range(3)])

    @staticmethod
    def _project(point: Any, intrinsics: list[Any]) -> tuple[Any, Any]:
        fx, fy, cx, cy = intrinsics
        return fx * point.x / point.z + cx, fy * point.y / point.z + cy
