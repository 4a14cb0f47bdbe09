"""The visibility term: moving outlines, by edge sampling (Li et al. 2018), the whole batch in a few launches.

∂I/∂θ at an outline is the radiance difference across it times the speed with which it moves along its normal. The image
is composited a little to either side (passes.py): a difference hidden behind another surface vanishes, so occlusion,
also by the object itself, needs no further care.

Most edges at which a detailed mesh turns away from the camera are hidden or show next to no difference. So edges are
cut into pieces of a pixel or two, and pieces are sampled in proportion to their length and to an importance: what the
rendered image and the adjoint around them let expect; the weights undo the preference.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from curio_train.rendering.bounds import NEAR_M
from curio_train.rendering.edge_search import EdgeSearch
from curio_train.rendering.instances import Instances
from curio_train.rendering.silhouette_edges import EdgeTable

OFFSET_PX = 0.001
"""How far beside an outline the image is sampled; with more, outlines that fold back are counted twice."""

PIECE_PX = 2.0
MAX_PIECES = 256  # of one edge: next to the camera an edge can be endless
_SEARCH_END = 1 << 25  # fixed, so that the number of steps and with it the program does not depend on the data

SamplingImportance = Callable[["Pieces"], Any]
"""Expected radiance difference times adjoint at pieces of outlines; zero only where there can be none."""


@dataclass(frozen=True)
class Pieces:
    """Short pieces of outlines, instances ascending."""

    instance: Any
    """Number of the instance."""
    edge: Any
    """Number of the edge in the table of edges."""
    start: Any
    """Where the piece begins, as a fraction of the edge's projection."""
    span: Any
    """Length of the piece, as a fraction of the edge's projection."""
    length: Any
    """Length of the piece, pixels."""
    x: Any
    y: Any
    """Position of its middle, pixels, centres at integers."""
    tangent_x: Any
    tangent_y: Any
    """Unit vector along it."""


@dataclass(frozen=True)
class OutlineSamples:
    """Points on outlines, the same number an instance, instance after instance."""

    instance: Any
    """Number of the instance."""
    x: Any
    y: Any
    """Position in pixels, centres at integers."""
    normal_x: Any
    normal_y: Any
    """Unit normal of the outline in the image."""
    weight: Any
    """Length of outline that the sample stands for, pixels; 0 where the instance has no outline."""
    scene_point: Any
    """The point on the edge, scene frame."""


class OutlineSampler:
    """Finds and samples the silhouette edges of all instances."""

    def __init__(self, mi: ModuleType, dr: ModuleType, edges: EdgeTable, kind_of_slot: Sequence[int]) -> None:
        self.mi, self.dr = mi, dr
        self.search = EdgeSearch(mi, dr, edges, kind_of_slot)

    def sample(
        self, instances: Instances, num_instances: int, num_samples: int, key: Any, importance: SamplingImportance
    ) -> OutlineSamples | None:
        """Sample outlines by length and importance, evenly spaced in each instance; None where no instance has any.

        Args:
            instances: All instances, detached.
            num_instances: Their number.
            num_samples: Points an instance.
            key: UInt32, added to the instance's number to draw the offset of its points.
            importance: See :data:`SamplingImportance`.
        """
        mi, dr = self.mi, self.dr
        instance, edge = self.search.find(instances, num_instances)
        if len(instance) == 0:
            return None
        pieces = self._cut(instances, instance, edge)
        density = importance(pieces)
        # In double precision: these are sums over all outlines of a batch.
        total = dr.cumsum(mi.Float64(density * pieces.length))
        border = self._first_of_instances(pieces.instance, num_instances)
        lane = dr.arange(mi.UInt32, num_instances * num_samples)
        instance = lane // num_samples
        first, end = (dr.gather(mi.UInt32, border, instance + i) for i in range(2))
        before, after = self._until(total, first), self._until(total, end)
        jitter = mi.Float64(mi.sample_tea_32(instance + key, mi.UInt32(0x9E3779B9))[0]) * 2.0**-32
        spacing = (after - before) / num_samples
        target = before + (mi.Float64(lane - instance * num_samples) + jitter) * spacing
        found = self._count_below(lambda i: dr.gather(mi.Float64, total, i) <= target, len(total))
        found = dr.clip(found, first, dr.maximum(end, first + 1) - 1)
        lower, upper = self._until(total, found), self._until(total, found + 1)
        within = mi.Float(dr.clip((target - lower) / dr.maximum(upper - lower, 1e-30), 0, 1))
        weight = mi.Float(spacing) / dr.gather(mi.Float, density, found)
        points = self._at(instances, pieces, instance, found, within, dr.select(spacing > 0, weight, 0))
        dr.eval(points.__dict__)
        return points

    def _cut(self, instances: Instances, instance: Any, edge: Any) -> Pieces:
        """Cut edges, so that what is known of a piece's middle holds for all of it."""
        mi, dr = self.mi, self.dr
        ends = [instances.to_camera(instance, p) for p in self.search.ends(edge)]
        visible = (ends[0].z > NEAR_M) & (ends[1].z > NEAR_M)
        (xa, ya), (xb, yb) = (instances.project(instance, p) for p in ends)
        length = dr.hypot(xb - xa, yb - ya)
        length = dr.select(visible & dr.isfinite(length), length, 0)
        count = mi.UInt32(dr.clip(dr.ceil(length / PIECE_PX), 1, MAX_PIECES))
        dr.eval(instance, edge, xa, ya, xb, yb, length, count)
        after = dr.cumsum(count)
        owner = dr.zeros(mi.UInt32, int(after[-1]))
        dr.scatter(owner, dr.arange(mi.UInt32, len(count)), after - count)
        owner = dr.prefix_reduce(dr.ReduceOp.Max, owner, exclusive=False)
        instance, edge, xa, ya, xb, yb, length, count, after = (
            dr.gather(type(v), v, owner) for v in (instance, edge, xa, ya, xb, yb, length, count, after)
        )
        span = 1 / mi.Float(count)
        start = (mi.Float(dr.arange(mi.UInt32, dr.width(owner)) + count) - mi.Float(after)) * span
        middle, inverse = start + span / 2, 1 / dr.maximum(length, 1e-9)
        pieces = Pieces(
            instance,
            edge,
            start,
            span,
            length * span,
            dr.lerp(xa, xb, middle),
            dr.lerp(ya, yb, middle),
            (xb - xa) * inverse,
            (yb - ya) * inverse,
        )
        dr.eval(pieces.__dict__)
        return pieces

    def _until(self, total: Any, index: Any) -> Any:
        """Sum of all entries before ``index``, from the inclusive prefix sum ``total``."""
        dr = self.dr
        return dr.select(index > 0, dr.gather(self.mi.Float64, total, index - 1, index > 0), 0)

    def _count_below(self, below: Any, count: int) -> Any:
        """Number of entries of an ascending array of length ``count`` that satisfy ``below(index)``."""
        dr, size = self.dr, self.dr.opaque(self.mi.UInt32, count)
        return self.mi.UInt32(dr.binary_search(0, _SEARCH_END, lambda i: (i < size) & below(dr.minimum(i, size - 1))))

    def _first_of_instances(self, instance: Any, num_instances: int) -> Any:
        """UInt32 [num_rows + 1], where each instance begins in the ascending ``instance``."""
        mi, dr = self.mi, self.dr
        wanted = dr.arange(mi.UInt32, num_instances + 1)
        first = self._count_below(lambda i: dr.gather(mi.UInt32, instance, i) < wanted, len(instance))
        dr.eval(first)
        return first

    def _at(
        self, instances: Instances, pieces: Pieces, instance: Any, piece: Any, within: Any, weight: Any
    ) -> OutlineSamples:
        mi, dr = self.mi, self.dr
        start, span, tangent_x, tangent_y = (
            dr.gather(mi.Float, v, piece) for v in (pieces.start, pieces.span, pieces.tangent_x, pieces.tangent_y)
        )
        ends = self.search.ends(dr.gather(mi.UInt32, pieces.edge, piece))
        in_camera = [instances.to_camera(instance, p) for p in ends]
        (xa, ya), (xb, yb) = (instances.project(instance, p) for p in in_camera)
        fraction = dr.fma(within, span, start)
        # Uniform along the projection is not uniform along the edge: undo the perspective.
        za, zb = in_camera[0].z, in_camera[1].z
        along = fraction * za / dr.maximum(dr.lerp(zb, za, fraction), 1e-9)
        x, y = dr.lerp(xa, xb, fraction), dr.lerp(ya, yb, fraction)
        return OutlineSamples(instance, x, y, -tangent_y, tangent_x, weight, dr.lerp(ends[0], ends[1], along))
