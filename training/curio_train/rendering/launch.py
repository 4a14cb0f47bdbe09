"""What all launches over one part of a batch share: tracing samples, and what their hits add to the image."""

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from curio_train.rendering.bounds import ImageBounds
from curio_train.rendering.compositing import Occlusion
from curio_train.rendering.layers import LayerTracer
from curio_train.rendering.pixels import Place
from curio_train.rendering.rows import Rows
from curio_train.rendering.silhouettes import OutlineSampler

Places = Callable[[Any], tuple[Place, Any]]
"""From the numbers of rays to their places and whether they are inside the image."""


@dataclass(frozen=True)
class Setting:
    """What all parts of all batches share.

    Attributes:
        mi: Mitsuba.
        dr: Dr.Jit.
        tracer: Traces and shades rays.
        outlines: Finds and samples silhouettes.
        width: Of the images, pixels.
        height: Of the images, pixels.
        num_slots: Objects an image.
        samples_per_pixel: Rays a pixel and slot.
        outline_samples: Points on each object's outline.
    """

    mi: ModuleType
    dr: ModuleType
    tracer: LayerTracer
    outlines: OutlineSampler
    width: int
    height: int
    num_slots: int
    samples_per_pixel: int
    outline_samples: int


@dataclass(frozen=True)
class View:
    """The part of a batch that is traced at once.

    Attributes:
        images: First and last + 1 image.
        bounds: Of the part's rows.
        camera: Float, see :class:`Rows`.
        key: Of all random numbers of the batch, UInt32.
    """

    images: tuple[int, int]
    bounds: ImageBounds
    camera: Any
    key: Any

    @property
    def num_images(self) -> int:
        """In this part."""
        return self.images[1] - self.images[0]


@dataclass(frozen=True)
class Hits:
    """Rays that hit their object.

    Attributes:
        lane: Which rays.
        at: Where they pass.
        record: Faces hit, Mitsuba's preliminary intersections.
        occlusion: Of the samples that the rays belong to.
    """

    lane: Any
    at: Places
    record: Any
    occlusion: Occlusion


class Launch:
    """Rays over one part of a batch, in front of its backgrounds (flat [b, 3, h, w])."""

    def __init__(self, setting: Setting, view: View, background: Any) -> None:
        self.set, self.view, self.background = setting, view, background
        self.mi, self.dr = setting.mi, setting.dr

    def trace(self, rows: Rows, lane: Any, at: Places, per_group: int, num_groups: int) -> Hits | None:
        """Trace rays and keep those that hit; None where none does. Samples come in groups, see :class:`Occlusion`."""
        mi, dr, tracer = self.mi, self.dr, self.set.tracer
        if len(lane) == 0:
            return None
        place, inside = at(lane)
        record = tracer.intersect(rows, place.row, tracer.ray(rows, place.row, place.x, place.y), inside)
        dr.eval(record)
        hit = dr.compress(record.is_valid())
        if len(hit) == 0:
            return None
        record, lane = dr.gather(type(record), record, hit), dr.gather(mi.UInt32, lane, hit)
        dr.eval(record, lane)
        occlusion = Occlusion(mi, dr, self.set.num_slots, per_group)
        if self.set.num_slots > 1:
            occlusion.build(at(lane)[0], record.t, num_groups)
        return Hits(lane, at, record, occlusion)

    def contributions(self, rows: Rows, hits: Hits) -> tuple[Place, list[Any]]:
        """What each hit adds to the colour of its sample: weight · (color − background), 3 arrays."""
        tracer, (place, _) = self.set.tracer, hits.at(hits.lane)
        ray = tracer.ray(rows, place.row, place.x, place.y)
        colors = tracer.shade(rows, place.row, ray, hits.record)
        weight = hits.occlusion.weight(rows, place, hits.record.t)
        behind = self.look(self.background, place.pixel)
        return place, [weight * (color - under) for color, under in zip(colors, behind, strict=True)]

    def weighed(self, rows: Rows, hits: Hits, adjoint: Any) -> tuple[Place, Any]:
        """The contributions' scalar product with the adjoint at their pixels."""
        place, colors = self.contributions(rows, hits)
        return place, sum(c * w for c, w in zip(colors, self.look(adjoint, place.pixel), strict=True))

    def look(self, flat: Any, pixel: Any) -> list[Any]:
        """The three channels of a flat [b, 3, h, w] array at pixels."""
        return [self.dr.gather(self.mi.Float, flat, i) for i in self.planes(pixel)]

    def planes(self, pixel: Any) -> list[Any]:
        """Where a pixel's three channels are in a flat [b, 3, h, w] array."""
        area = self.set.width * self.set.height
        first = pixel + (pixel // area) * (2 * area)
        return [first + channel * area for channel in range(3)]

    def nearest_pixel(self, image: Any, x: Any, y: Any, margin: float = 0.0) -> tuple[Any, Any]:
        """The pixel at (x, y), or the nearest one inside; and whether (x, y) is inside, give or take a margin."""
        mi, dr, width, height = self.mi, self.dr, self.set.width, self.set.height
        column, line = dr.floor(x + 0.5), dr.floor(y + 0.5)
        inside = (column >= -margin) & (column < width + margin) & (line >= -margin) & (line < height + margin)
        column, line = mi.UInt32(dr.clip(column, 0, width - 1)), mi.UInt32(dr.clip(line, 0, height - 1))
        return (image * height + line) * width + column, inside
