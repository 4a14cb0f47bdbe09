"""Find the edges at which a camera sees an outline, for all rows at once: clusters first, then edges."""

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np

from curio_train.rendering.instances import Instances
from curio_train.rendering.silhouette_edges import CLUSTER_SIZE, EdgeTable


class EdgeSearch:
    """The edge table in Dr.Jit, and which of its clusters belong to which slot."""

    def __init__(self, mi: ModuleType, dr: ModuleType, edges: EdgeTable, kind_of_slot: Sequence[int]) -> None:
        self.mi, self.dr = mi, dr
        self.edges = {
            name: mi.Float(np.ascontiguousarray(getattr(edges, name)).ravel())
            for name in ("start", "end", "normal_a", "normal_b", "center", "radius", "axis", "angle", "facing")
        }
        clusters = [np.arange(edges.first_cluster[k], edges.first_cluster[k + 1]) for k in kind_of_slot]
        slots = np.repeat(np.arange(len(clusters)), [len(c) for c in clusters])
        self.slot_of_pair = mi.UInt32(slots.astype(np.uint32))
        self.cluster_of_pair = mi.UInt32(np.concatenate(clusters).astype(np.uint32))
        self.num_pairs, self.num_slots = len(slots), len(kind_of_slot)

    def ends(self, edge: Any) -> list[Any]:
        """Both ends of edges, scene frame."""
        return [self._point(name, edge) for name in ("start", "end")]

    def find(self, rows: Instances, num_rows: int) -> tuple[Any, Any]:
        """(row, edge) of every silhouette edge, rows ascending."""
        mi, dr = self.mi, self.dr
        if self.num_pairs == 0:
            return mi.UInt32(), mi.UInt32()
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

    def _may_have_outline(self, rows: Instances, row: Any, cluster: Any) -> Any:
        """False only where every face of the cluster surely looks to the same side of the camera."""
        mi, dr = self.mi, self.dr
        to_camera = rows.toward(row, self._point("center", cluster))
        distance = dr.norm(to_camera)
        radius = dr.gather(mi.Float, self.edges["radius"], cluster)
        cosine = dr.dot(to_camera, self._point("axis", cluster)) / dr.maximum(distance, 1e-12)
        between = dr.acos(dr.clip(cosine, -1, 1))
        spread = dr.gather(mi.Float, self.edges["angle"], cluster) + dr.asin(
            dr.clip(radius / dr.maximum(distance, 1e-12), 0, 1)
        )
        beyond = between - dr.pi / 2
        facing = dr.gather(mi.Float, self.edges["facing"], cluster)
        return dr.select(facing > 0, beyond, dr.abs(beyond)) <= spread

    def _is_outline(self, rows: Instances, row: Any, edge: Any) -> Any:
        """One face towards the camera and one away, or an open border; at folds as many towards it as are needed."""
        dr = self.dr
        to_camera = rows.toward(row, self._point("start", edge))
        a, b = (dr.dot(self._point(name, edge), to_camera) for name in ("normal_a", "normal_b"))
        facing = dr.gather(self.mi.Float, self.edges["facing"], edge // CLUSTER_SIZE)
        unknown = (a == 0) & (b == 0)
        enough = dr.select(facing > 1, dr.minimum(a, b), dr.maximum(a, b)) > 0
        return unknown | dr.select(facing > 0, enough, a * b <= 0)

    def _point(self, name: str, index: Any) -> Any:
        return self.mi.Vector3f(*[self.dr.gather(self.mi.Float, self.edges[name], index * 3 + i) for i in range(3)])
