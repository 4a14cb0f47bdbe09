"""The silhouette part of the gradient: what jumps across outlines, and where they move."""

from typing import Any

from curio_train.rendering.edge_sampling import OFFSET_PX, PIECE_PX, OutlineSamples, Pieces
from curio_train.rendering.instances import Instances
from curio_train.rendering.launch import Launch
from curio_train.rendering.pixels import Place

CONTRAST_FLOOR = 0.05
"""What an outline may jump by where the image shows no contrast, so that every outline has a chance to be sampled."""


class Outlines(Launch):
    """Rays beside the outlines of one part of a batch."""

    def displacement(self, rows: Instances, image: Any, adjoint: Any) -> Any:
        """Jump of colour · adjoint · displacement along the normal, attached to ``rows``; None without outlines."""
        dr, still, view = self.dr, rows.detached(), self.view
        points = self.set.outlines.sample(
            still,
            view.num_images * self.set.num_slots,
            self.set.outline_samples,
            view.key + dr.opaque(self.mi.UInt32, view.images[0] * self.set.num_slots),
            lambda pieces: self._promise(pieces, image, adjoint),
        )
        if points is None:
            return None
        push = self._jump(still, points, adjoint) * points.weight
        # Only what pushes is projected: elsewhere a depth of zero could make 0 · ∞.
        pushing = dr.compress(push != 0)
        if len(pushing) == 0:
            return None
        push, row, normal_x, normal_y, scene_point = (
            dr.gather(type(v), v, pushing)
            for v in (push, points.row, points.normal_x, points.normal_y, points.scene_point)
        )
        x, y = rows.project(row, rows.to_camera(row, scene_point))
        return push * (normal_x * x + normal_y * y)

    def _promise(self, pieces: Pieces, image: Any, adjoint: Any) -> Any:
        """|adjoint| · (contrast of the image across the piece + a floor), per pixel of length."""
        dr, where = self.dr, pieces.row // self.set.num_slots
        tx, ty = pieces.tangent_x, pieces.tangent_y

        def look(flat: Any, dx: Any, dy: Any) -> list[Any]:
            return self.look(flat, self.nearest_pixel(where, pieces.x + dx, pieces.y + dy)[0])

        here, left, right = (look(image, -s * ty, s * tx) for s in (0, 1, -1))
        weights = [look(adjoint, s * tx * PIECE_PX / 2, s * ty * PIECE_PX / 2) for s in (0, 1, -1)]
        promise = 0.0
        for c in range(self.view.sight.channels):
            contrast = dr.abs(here[c] - left[c]) + dr.abs(here[c] - right[c])
            promise += sum(dr.abs(w[c]) for w in weights) * (contrast + CONTRAST_FLOOR)
        inside = self.nearest_pixel(where, pieces.x, pieces.y, PIECE_PX)[1]
        return dr.select(inside, promise, 0)

    def _jump(self, rows: Instances, points: OutlineSamples, adjoint: Any) -> Any:
        """Scalar product of the adjoint with the colour on one side of each point minus that on the other."""
        mi, dr = self.mi, self.dr
        num_points = len(points.row)
        lane = dr.arange(mi.UInt32, num_points * 2 * self.set.num_slots)

        def at(lane: Any) -> tuple[Place, Any]:
            return self._beside(points, lane)

        if self.set.num_slots > 1:
            place, inside = at(lane)
            lane = dr.compress(inside & self.set.tracer.near(rows, place.row, rows.ray(place.row, place.x, place.y)))
        hits = self.trace(rows, lane, at, 1, num_points * 2)
        jump = dr.zeros(mi.Float, num_points)
        if hits:
            place, value = self.weighed(rows, hits, adjoint)
            signed = dr.select((place.sample & 1) == 0, value, -value)
            # Left to itself, Dr.Jit chooses a way that writes the number of points into the program.
            dr.scatter_add(jump, signed, place.sample >> 1, mode=dr.ReduceMode.Local)
        dr.eval(jump)
        return jump

    def _beside(self, points: OutlineSamples, lane: Any) -> tuple[Place, Any]:
        """Samples beside the outlines as every slot sees them: (row, slot, point, side), the last running fastest."""
        mi, dr, n, per_row = self.mi, self.dr, self.set.num_slots, self.set.outline_samples
        entry = lane >> 1
        block = entry // per_row
        own = block // n
        index = own * per_row + entry - block * per_row
        image = own // n
        row = image * n + block - own * n
        offset = dr.select((lane & 1) == 0, -OFFSET_PX, OFFSET_PX)
        x, y, nx, ny, weight = (
            dr.gather(mi.Float, v, index) for v in (points.x, points.y, points.normal_x, points.normal_y, points.weight)
        )
        pixel, inside = self.nearest_pixel(image, x, y)
        return Place(row, pixel, index * 2 + (lane & 1), x + offset * nx, y + offset * ny), inside & (weight > 0)
