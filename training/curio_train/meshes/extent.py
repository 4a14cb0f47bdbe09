"""How large a point set is: its exact diameter and its box, for millions of points in seconds."""

import heapq
from functools import cached_property

import numpy as np
from scipy.spatial.distance import cdist

_LEAF = 64
# Where everything is as far apart as everything else (a ring, a sphere), the last digits are not worth the search.
_RELATIVE_TOLERANCE = 1e-7


class _Cell:
    """Points [n, 3] that lie together, with their box; split when first needed, and once."""

    def __init__(self, points: np.ndarray) -> None:
        self.points, self.low, self.high = points, points.min(axis=0), points.max(axis=0)

    @cached_property
    def halves(self) -> tuple["_Cell", "_Cell"]:
        middle = len(self.points) // 2
        order = np.argpartition(self.points[:, (self.high - self.low).argmax()], middle)
        return _Cell(self.points[order[:middle]]), _Cell(self.points[order[middle:]])

    def largest_possible_distance(self, other: "_Cell") -> float:
        """Upper bound of the distance of a point here from one there."""
        reach = np.maximum(self.high - other.low, other.high - self.low)
        return float(np.sqrt(reach @ reach))


def box_corners(points: np.ndarray) -> np.ndarray:
    """Corners [8, 3] of the axis-aligned box of points [n, 3].

    Corner i takes the upper end of x where bit 0 of i is set, of y for bit 1, of z for bit 2. Two corners share an edge
    where their numbers differ in one bit.
    """
    ends = np.stack([points.min(axis=0), points.max(axis=0)])
    bits = np.arange(8)[:, None] >> np.arange(3) & 1
    return np.take_along_axis(ends, bits, axis=0)


def diameter(points: np.ndarray) -> float:
    """Largest distance of two of the points [n, 3], to one part in ten million.

    Branch and bound over pairs of cells, most promising pair first: when the largest possible distance of the next
    pair is no larger than the largest found, that one is the diameter.
    """
    points = points - (points.min(axis=0) + points.max(axis=0)) / 2
    found = _long_distance(points)
    radius = np.linalg.norm(points, axis=1)
    points = points[radius + radius.max() > found * (1 + _RELATIVE_TOLERANCE)]
    if len(points) == 0:
        return found
    root, num_pushed = _Cell(points), 0
    queue = [(-np.inf, 0, root, root)]
    while queue and -queue[0][0] > found * (1 + _RELATIVE_TOLERANCE):
        _, _, a, b = heapq.heappop(queue)
        if max(len(a.points), len(b.points)) <= _LEAF:
            found = max(found, float(cdist(a.points, b.points).max()))
            continue
        for near, far in _split(a, b):
            bound = near.largest_possible_distance(far)
            if bound > found * (1 + _RELATIVE_TOLERANCE):
                num_pushed += 1  # also keeps the queue from comparing cells
                heapq.heappush(queue, (-bound, num_pushed, near, far))
    return found


def _long_distance(points: np.ndarray) -> float:
    """A distance that occurs, usually the diameter: to the farthest point, from there to its farthest, and on."""
    found, start = 0.0, points[np.linalg.norm(points, axis=1).argmax()]
    for _ in range(8):
        distance = np.linalg.norm(points - start, axis=1)
        start, longest = points[distance.argmax()], float(distance.max())
        if longest <= found:
            break
        found = longest
    return found


def _split(a: _Cell, b: _Cell) -> list[tuple[_Cell, _Cell]]:
    """Pairs that together hold every pair of ``a`` and ``b``; a cell paired with itself needs three, not four."""
    if a is b:
        low, high = a.halves
        return [(low, low), (low, high), (high, high)]
    if len(a.points) < len(b.points):
        a, b = b, a
    return [(half, b) for half in a.halves]
