"""The visibility term: moving outlines, by edge sampling (Li et al. 2018), the whole batch in a few launches.

∂I/∂θ at an outline is the jump of colour across it times the speed with which it moves along its normal. The image is
composited a little to either side (passes.py): a jump hidden behind another surface is no jump, so occlusion, also by
the object itself, needs no further care.

Most edges at which a detailed mesh turns away from the camera are hidden or jump by next to nothing. So edges are cut
into pieces of a pixel or two, and pieces are sampled in proportion to their length and to what the rendered image and
the adjoint around them promise; the weights undo the preference.
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
"""How far beside an outline the image is looked at; with more, outlines that fold back are counted twice."""

PIECE_PX = 2.0
MAX_PIECES = 256  # of one edge: next to the camera an edge can be endless
_SEARCH_END = 1 << 25  # fixed, so that the number of steps and with it the program does not depend on the data

SamplingImportance = Callable[["Pieces"], Any]
"""How much colour, weighed by the adjoint, may jump at pieces of outlines; zero only where it cannot."""


@dataclass(frozen=True)
class Pieces:
    """Short pieces of outlines, rows ascending.

    Attributes:
        row: Which object in which image.
        edge: Of the table.
        start: Where the piece begins, as a share of the edge's projection.
        share: Its length, likewise.
        length: In pixels.
        x, y: Position of its middle, pixels, centres at integers.
        tangent_x, tangent_y: Unit vector along it.
    """

    row: Any
    edge: Any
    start: Any
    share: Any
    length: Any
    x: Any
    y: Any
    tangent_x: Any
    tangent_y: Any


@dataclass(frozen=True)
class OutlineSamples:
    """Points on outlines, the same number a row, row after row.

    Attributes:
        row: Which object in which image.
        x, y: Position in pixels, centres at integers.
        normal_x, normal_y: Unit normal of the outline in the image.
        weight: Length of outline that the sample stands for, pixels; 0 where the row has no outline.
        scene_point: The point on the edge, scene frame.
    """

    row: Any
    x: Any
    y: Any
    normal_x: Any
    normal_y: Any
    weight: Any
    scene_point: Any


class OutlineSampler:
    """Finds and samples the silhouette edges of all rows."""

    def __init__(self, mi: ModuleType, dr: ModuleType, edges: EdgeTable, kind_of_slot: Sequence[int]) -> None:
        self.mi, self.dr = mi, dr
        self.search = EdgeSearch(mi, dr, edges, kind_of_slot)

    def sample(
        self, rows: Instances, num_rows: int, num_samples: int, key: Any, promise: SamplingImportance
    ) -> OutlineSamples | None:
        """Sample outlines by length and promise, evenly spaced in each row; None where no row has any.

        Args:
            rows: All rows, detached.
            num_rows: Their number.
            num_samples: Points a row.
            key: UInt32, added to the row's number to draw the offset of its points.
            promise: See :data:`SamplingImportance`.
        """
        mi, dr = self.mi, self.dr
        row, edge = self.search.find(rows, num_rows)
        if len(row) == 0:
            return None
        pieces = self._cut(rows, row, edge)
        density = promise(pieces)
        # In double precision: these are sums over all outlines of a batch.
        total = dr.cumsum(mi.Float64(density * pieces.length))
        border = self._first_of_rows(pieces.row, num_rows)
        lane = dr.arange(mi.UInt32, num_rows * num_samples)
        row = lane // num_samples
        first, end = (dr.gather(mi.UInt32, border, row + i) for i in range(2))
        before, after = self._until(total, first), self._until(total, end)
        jitter = mi.Float64(mi.sample_tea_32(row + key, mi.UInt32(0x9E3779B9))[0]) * 2.0**-32
        spacing = (after - before) / num_samples
        target = before + (mi.Float64(lane - row * num_samples) + jitter) * spacing
        found = self._count_below(lambda i: dr.gather(mi.Float64, total, i) <= target, len(total))
        found = dr.clip(found, first, dr.maximum(end, first + 1) - 1)
        lower, upper = self._until(total, found), self._until(total, found + 1)
        within = mi.Float(dr.clip((target - lower) / dr.maximum(upper - lower, 1e-30), 0, 1))
        weight = mi.Float(spacing) / dr.gather(mi.Float, density, found)
        points = self._at(rows, pieces, row, found, within, dr.select(spacing > 0, weight, 0))
        dr.eval(points.__dict__)
        return points

    def _cut(self, rows: Instances, row: Any, edge: Any) -> Pieces:
        """Cut edges, so that what is known of a piece's middle holds for all of it."""
        mi, dr = self.mi, self.dr
        ends = [rows.to_camera(row, p) for p in self.search.ends(edge)]
        visible = (ends[0].z > NEAR_M) & (ends[1].z > NEAR_M)
        (xa, ya), (xb, yb) = (rows.project(row, p) for p in ends)
        length = dr.hypot(xb - xa, yb - ya)
        length = dr.select(visible & dr.isfinite(length), length, 0)
        count = mi.UInt32(dr.clip(dr.ceil(length / PIECE_PX), 1, MAX_PIECES))
        dr.eval(row, edge, xa, ya, xb, yb, length, count)
        after = dr.cumsum(count)
        owner = dr.zeros(mi.UInt32, int(after[-1]))
        dr.scatter(owner, dr.arange(mi.UInt32, len(count)), after - count)
        owner = dr.prefix_reduce(dr.ReduceOp.Max, owner, exclusive=False)
        row, edge, xa, ya, xb, yb, length, count, after = (
            dr.gather(type(v), v, owner) for v in (row, edge, xa, ya, xb, yb, length, count, after)
        )
        share = 1 / mi.Float(count)
        start = (mi.Float(dr.arange(mi.UInt32, dr.width(owner)) + count) - mi.Float(after)) * share
        middle, inverse = start + share / 2, 1 / dr.maximum(length, 1e-9)
        pieces = Pieces(
            row,
            edge,
            start,
            share,
            length * share,
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
        """How many entries of an ascending array of ``count`` satisfy ``below(index)``."""
        dr, size = self.dr, self.dr.opaque(self.mi.UInt32, count)
        return self.mi.UInt32(dr.binary_search(0, _SEARCH_END, lambda i: (i < size) & below(dr.minimum(i, size - 1))))

    def _first_of_rows(self, row: Any, num_rows: int) -> Any:
        """UInt32 [num_rows + 1], where each row begins in the ascending ``row``."""
        mi, dr = self.mi, self.dr
        wanted = dr.arange(mi.UInt32, num_rows + 1)
        first = self._count_below(lambda i: dr.gather(mi.UInt32, row, i) < wanted, len(row))
        dr.eval(first)
        return first

    def _at(self, rows: Instances, pieces: Pieces, row: Any, piece: Any, within: Any, weight: Any) -> OutlineSamples:
        mi, dr = self.mi, self.dr
        start, share, tangent_x, tangent_y = (
            dr.gather(mi.Float, v, piece) for v in (pieces.start, pieces.share, pieces.tangent_x, pieces.tangent_y)
        )
        ends = self.search.ends(dr.gather(mi.UInt32, pieces.edge, piece))
        in_camera = [rows.to_camera(row, p) for p in ends]
        (xa, ya), (xb, yb) = (rows.project(row, p) for p in in_camera)
        fraction = dr.fma(within, share, start)
        # Uniform along the projection is not uniform along the edge: undo the perspective.
        za, zb = in_camera[0].z, in_camera[1].z
        along = fraction * za / dr.maximum(dr.lerp(zb, za, fraction), 1e-9)
        x, y = dr.lerp(xa, xb, fraction), dr.lerp(ya, yb, fraction)
        return OutlineSamples(row, x, y, -tangent_y, tangent_x, weight, dr.lerp(ends[0], ends[1], along))
