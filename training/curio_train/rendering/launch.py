"""What all launches over one part of a batch share: tracing samples, and what their hits add to the image."""

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from curio_train.rendering.bounds import ImageBounds
from curio_train.rendering.compositing import Occlusion
from curio_train.rendering.edge_sampling import OutlineSampler
from curio_train.rendering.instances import Instances
from curio_train.rendering.pixels import Place
from curio_train.rendering.shadows import Blockers
from curio_train.rendering.tracing import LayerTracer, RayQuery

Places = Callable[[Any], tuple[Place, Any]]
"""From the numbers of rays to their places and whether they are inside the image."""


@dataclass(frozen=True)
class RenderSettings:
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
        object_shadows: Whether objects stand in each other's light.
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
    object_shadows: bool


@dataclass(frozen=True)
class View:
    """The part of a batch that is traced at once.

    Attributes:
        images: First and last + 1 image.
        sight: What is looked for.
        bounds: Of the part's rows.
        camera: Float, see :class:`Instances`.
        key: Of all random numbers of the batch, UInt32.
        finish: Float, see :class:`Instances`, or None.
    """

    images: tuple[int, int]
    sight: RayQuery
    bounds: ImageBounds
    camera: Any
    key: Any
    finish: Any = None

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
        blockers: What keeps the light from the hits, or None.
    """

    lane: Any
    at: Places
    record: Any
    occlusion: Occlusion
    blockers: Blockers | None


class Launch:
    """Rays over one part of a batch, in front of its backgrounds (flat [b, c, h, w])."""

    def __init__(self, setting: RenderSettings, view: View, background: Any) -> None:
        self.set, self.view, self.background = setting, view, background
        self.mi, self.dr = setting.mi, setting.dr

    def trace(self, rows: Instances, lane: Any, at: Places, per_group: int, num_groups: int) -> Hits | None:
        """Trace rays and keep those that hit; None where none does. Samples come in groups, see :class:`Occlusion`."""
        mi, dr, tracer = self.mi, self.dr, self.set.tracer
        if len(lane) == 0:
            return None
        place, inside = at(lane)
        ray = rows.ray(place.row, place.x, place.y)
        record = tracer.intersect(rows, place.row, ray, inside, self.view.sight.reach_from_m)
        dr.eval(record)
        hit = dr.compress(record.is_valid())
        if len(hit) == 0:
            return None
        record, lane = dr.gather(type(record), record, hit), dr.gather(mi.UInt32, lane, hit)
        dr.eval(record, lane)
        occlusion = Occlusion(mi, dr, self.set.num_slots, per_group)
        if self.set.num_slots > 1:
            occlusion.build(at(lane)[0], record.t, num_groups)
        return Hits(lane, at, record, occlusion, self._blockers(rows, at(lane)[0], record.t))

    def _blockers(self, rows: Instances, place: Place, depth_m: Any) -> Blockers | None:
        if not self.set.object_shadows or self.set.num_slots == 1 or not self.view.sight.shaded:
            return None
        blockers = Blockers(self.mi, self.dr, self.set.tracer, self.set.num_slots)
        blockers.find(rows.detached(), place, depth_m)
        return blockers

    def contributions(self, rows: Instances, hits: Hits) -> tuple[Place, list[Any]]:
        """What each hit adds to the colour of its sample: weight · (color − background), one array a channel."""
        place, _ = hits.at(hits.lane)
        lit = hits.blockers.lit(rows, place) if hits.blockers else 1.0
        colors = self.view.sight.colors(self.set.tracer, rows, place, hits.record, lit)
        weight = hits.occlusion.weight(rows, place, hits.record.t)
        behind = self.look(self.background, place.pixel)
        return place, [weight * (color - under) for color, under in zip(colors, behind, strict=True)]

    def weighed(self, rows: Instances, hits: Hits, adjoint: Any) -> tuple[Place, Any]:
        """The contributions' scalar product with the adjoint at their pixels."""
        place, colors = self.contributions(rows, hits)
        return place, sum(c * w for c, w in zip(colors, self.look(adjoint, place.pixel), strict=True))

    def look(self, flat: Any, pixel: Any) -> list[Any]:
        """The channels of a flat [b, c, h, w] array at pixels."""
        return [self.dr.gather(self.mi.Float, flat, i) for i in self.planes(pixel)]

    def planes(self, pixel: Any) -> list[Any]:
        """Where a pixel's channels are in a flat [b, c, h, w] array."""
        area, channels = self.set.width * self.set.height, self.view.sight.channels
        first = pixel + (pixel // area) * ((channels - 1) * area)
        return [first + channel * area for channel in range(channels)]

    def nearest_pixel(self, image: Any, x: Any, y: Any, margin: float = 0.0) -> tuple[Any, Any]:
        """The pixel at (x, y), or the nearest one inside; and whether (x, y) is inside, give or take a margin."""
        mi, dr, width, height = self.mi, self.dr, self.set.width, self.set.height
        column, line = dr.floor(x + 0.5), dr.floor(y + 0.5)
        inside = (column >= -margin) & (column < width + margin) & (line >= -margin) & (line < height + margin)
        column, line = mi.UInt32(dr.clip(column, 0, width - 1)), mi.UInt32(dr.clip(line, 0, height - 1))
        return (image * height + line) * width + column, inside
