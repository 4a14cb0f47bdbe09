"""Which pixels each instance traces, in tiles of 2x2, and where in a pixel each of its samples lies."""

import math
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from curio_train.rendering.bounds import DIRECTIONS, ImageBounds

TILE = 2  # with 4 samples a pixel, the 16 rays of a tile are one packet of neighbours
TILE_AREA = TILE * TILE


@dataclass(frozen=True)
class ImageLocation:
    """Points in images, with one entry a ray."""

    instance: Any
    """Number of the instance."""
    pixel: Any
    """(image · height + line) · width + column."""
    sample: Any
    """Which of its image's samples this is; samples with equal numbers are the same point."""
    x: Any
    y: Any
    """Position in pixels, centres at integers."""


class PixelSamples:
    """The rays of one part of a batch: (tile, pixel of the tile, sample of the pixel), the last running fastest."""

    def __init__(
        self,
        mi: ModuleType,
        dr: ModuleType,
        bounds: ImageBounds,
        num_slots: int,
        size: tuple[int, int],
        samples_per_pixel: int,
        key: Any,
    ) -> None:
        """List the tiles.

        Args:
            mi: Mitsuba.
            dr: Dr.Jit.
            bounds: Of each instance.
            num_slots: Instances an image.
            size: Width and height of the images.
            samples_per_pixel: Rays a pixel and instance.
            key: UInt32, added to the pixel's number to draw the jitter: depends on seed and place in the batch alone.
        """
        self.mi, self.dr = mi, dr
        self.num_slots, self.size, self.samples_per_pixel, self.key = num_slots, size, samples_per_pixel, key
        self.tile_instance, self.tile_corner = self._list_tiles(bounds)

    def __len__(self) -> int:
        return len(self.tile_instance) * TILE_AREA * self.samples_per_pixel

    def _list_tiles(self, bounds: ImageBounds) -> tuple[Any, Any]:
        """Instance and corner (line · width + column) of each tile that the bounds touch."""
        mi, dr = self.mi, self.dr
        x0, y0, x1, y1 = bounds.rectangle.T
        x0, y0 = x0 // TILE, y0 // TILE
        across, down = -(-x1 // TILE) - x0, -(-y1 // TILE) - y0
        counts = np.where((x1 > x0 * TILE) & (y1 > y0 * TILE), across * down, 0)
        if counts.sum() == 0:
            return mi.UInt32(), mi.UInt32()
        instance = mi.UInt32(np.repeat(np.arange(len(counts), dtype=np.uint32), counts))
        start, x0, y0, across = (mi.UInt32(v.astype(np.uint32)) for v in (np.cumsum(counts) - counts, x0, y0, across))
        local = dr.arange(mi.UInt32, len(instance)) - dr.gather(mi.UInt32, start, instance)
        # Also the lanes beside the last one divide, and those gather zeros.
        across = dr.maximum(dr.gather(mi.UInt32, across, instance), 1)
        line = local // across
        column = (dr.gather(mi.UInt32, x0, instance) + local - line * across) * TILE
        line = (dr.gather(mi.UInt32, y0, instance) + line) * TILE
        kept = dr.compress(self._touched(bounds, instance, column, line))
        instance, corner = (dr.gather(mi.UInt32, v, kept) for v in (instance, line * self.size[0] + column))
        dr.eval(instance, corner)
        return instance, corner

    def _touched(self, bounds: ImageBounds, instance: Any, column: Any, line: Any) -> Any:
        """Whether the object's bounds, seen from each direction, overlap the tile."""
        mi, dr = self.mi, self.dr
        low, high = mi.Float(bounds.low.ravel()), mi.Float(bounds.high.ravel())
        x, y = mi.Float(column) + (TILE - 1) / 2, mi.Float(line) + (TILE - 1) / 2
        touched = mi.Bool(True)
        for i, (a, b) in enumerate(DIRECTIONS):
            middle, half = a * x + b * y, (abs(a) + abs(b)) * TILE / 2
            at = instance * len(DIRECTIONS) + i
            touched &= dr.gather(mi.Float, low, at) <= middle + half
            touched &= dr.gather(mi.Float, high, at) >= middle - half
        return touched

    def at(self, lane: Any) -> tuple[ImageLocation, Any]:
        """Image position of a ray, and whether it is inside the image (sizes may be odd)."""
        mi, dr, spp, (width, height) = self.mi, self.dr, self.samples_per_pixel, self.size
        entry = lane // spp
        tile = entry // TILE_AREA
        within = entry - tile * TILE_AREA
        instance, corner = dr.gather(mi.UInt32, self.tile_instance, tile), dr.gather(mi.UInt32, self.tile_corner, tile)
        line = corner // width
        column = corner - line * width + within % TILE
        line += within // TILE
        pixel = (instance // self.num_slots * height + line) * width + column
        dx, dy = self._jitter(pixel, lane - entry * spp)
        location = ImageLocation(
            instance, pixel, pixel * spp + lane - entry * spp, mi.Float(column) + dx, mi.Float(line) + dy
        )
        return location, (column < width) & (line < height)

    def _jitter(self, pixel: Any, sample: Any) -> tuple[Any, Any]:
        """Offset from the pixel's centre in [−0.5, 0.5), the same for all instances of an image.

        With n² samples a pixel, each has its own cell of n x n, its own column of n² and its own row of n² (the
        canonical arrangement of multi-jittered sampling, Chiu et al. 1994), rotated at random in each pixel.
        """
        mi, spp = self.mi, self.samples_per_pixel
        n = math.isqrt(spp)
        u, v = (mi.Float(bits) * 2.0**-32 for bits in mi.sample_tea_32(pixel + self.key, sample))
        if n * n == spp:
            across, down = (bits % n for bits in mi.sample_tea_32(pixel + self.key, mi.UInt32(spp)))
            i, j = sample % n, sample // n
            u = (mi.Float(i * n + (j + across) % n) + u) / spp
            v = (mi.Float(j * n + (i + down) % n) + v) / spp
        return u - 0.5, v - 0.5
