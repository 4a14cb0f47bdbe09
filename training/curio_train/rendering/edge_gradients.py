"""The silhouette part of the gradient: radiance differences across outlines times their motion (Li et al. 2018)."""

from typing import Any

from curio_train.rendering.edge_sampling import OFFSET_PX, PIECE_PX, OutlineSamples, Pieces
from curio_train.rendering.instances import Instances
from curio_train.rendering.launch import Launch
from curio_train.rendering.pixels import ImageLocation

CONTRAST_FLOOR = 0.05
"""Radiance difference that an outline may have where the image shows no contrast, so that every outline has a chance to
be sampled."""


class Outlines(Launch):
    """Rays beside the outlines of one part of a batch."""

    def displacement(self, instances: Instances, image: Any, adjoint: Any) -> Any:
        """Radiance difference · adjoint · displacement along the normal, summed; None without outlines.

        The result is attached to ``instances``.
        """
        dr, detached, view = self.dr, instances.detached(), self.view
        points = self.set.outlines.sample(
            detached,
            view.num_images * self.set.num_slots,
            self.set.outline_samples,
            view.key + dr.opaque(self.mi.UInt32, view.images[0] * self.set.num_slots),
            lambda pieces: self._importance(pieces, image, adjoint),
        )
        if points is None:
            return None
        weighted = self._radiance_difference(detached, points, adjoint) * points.weight
        # Only points with a difference are projected: elsewhere a depth of zero could make 0 · ∞.
        nonzero = dr.compress(weighted != 0)
        if len(nonzero) == 0:
            return None
        weighted, instance, normal_x, normal_y, scene_point = (
            dr.gather(type(v), v, nonzero)
            for v in (weighted, points.instance, points.normal_x, points.normal_y, points.scene_point)
        )
        x, y = instances.project(instance, instances.to_camera(instance, scene_point))
        return weighted * (normal_x * x + normal_y * y)

    def _importance(self, pieces: Pieces, image: Any, adjoint: Any) -> Any:
        """|adjoint| · (contrast of the image across the piece + a floor), per pixel of length."""
        dr, where = self.dr, pieces.instance // self.set.num_slots
        tx, ty = pieces.tangent_x, pieces.tangent_y

        def channels_at(flat: Any, dx: Any, dy: Any) -> list[Any]:
            return self.channels_at(flat, self.nearest_pixel(where, pieces.x + dx, pieces.y + dy)[0])

        here, left, right = (channels_at(image, -s * ty, s * tx) for s in (0, 1, -1))
        weights = [channels_at(adjoint, s * tx * PIECE_PX / 2, s * ty * PIECE_PX / 2) for s in (0, 1, -1)]
        importance = 0.0
        for c in range(self.view.query.channels):
            contrast = dr.abs(here[c] - left[c]) + dr.abs(here[c] - right[c])
            importance += sum(dr.abs(w[c]) for w in weights) * (contrast + CONTRAST_FLOOR)
        inside = self.nearest_pixel(where, pieces.x, pieces.y, PIECE_PX)[1]
        return dr.select(inside, importance, 0)

    def _radiance_difference(self, instances: Instances, points: OutlineSamples, adjoint: Any) -> Any:
        """Scalar product of the adjoint with the colour on one side of each point minus that on the other."""
        mi, dr = self.mi, self.dr
        num_points = len(points.instance)
        lane = dr.arange(mi.UInt32, num_points * 2 * self.set.num_slots)

        def at(lane: Any) -> tuple[ImageLocation, Any]:
            return self._beside(points, lane)

        if self.set.num_slots > 1:
            location, inside = at(lane)
            lane = dr.compress(
                inside
                & self.set.tracer.near(
                    instances, location.instance, instances.ray(location.instance, location.x, location.y)
                )
            )
        hits = self.trace(instances, lane, at, 1, num_points * 2)
        difference = dr.zeros(mi.Float, num_points)
        if hits:
            location, value = self.weighed(instances, hits, adjoint)
            signed = dr.select((location.sample & 1) == 0, value, -value)
            # Left to itself, Dr.Jit chooses a way that writes the number of points into the program.
            dr.scatter_add(difference, signed, location.sample >> 1, mode=dr.ReduceMode.Local)
        dr.eval(difference)
        return difference

    def _beside(self, points: OutlineSamples, lane: Any) -> tuple[ImageLocation, Any]:
        """Samples beside the outlines, seen by every slot: (instance, slot, point, side), the last fastest."""
        mi, dr, n, per_instance = self.mi, self.dr, self.set.num_slots, self.set.outline_samples
        entry = lane >> 1
        block = entry // per_instance
        own = block // n
        index = own * per_instance + entry - block * per_instance
        image = own // n
        instance = image * n + block - own * n
        offset = dr.select((lane & 1) == 0, -OFFSET_PX, OFFSET_PX)
        x, y, nx, ny, weight = (
            dr.gather(mi.Float, v, index) for v in (points.x, points.y, points.normal_x, points.normal_y, points.weight)
        )
        pixel, inside = self.nearest_pixel(image, x, y)
        return ImageLocation(instance, pixel, index * 2 + (lane & 1), x + offset * nx, y + offset * ny), inside & (
            weight > 0
        )
