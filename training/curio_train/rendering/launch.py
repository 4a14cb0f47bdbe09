"""What all launches over one part of a batch share: tracing samples, and what their hits add to the image."""

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from curio_train.rendering.bounds import ImageBounds
from curio_train.rendering.compositing import Occlusion
from curio_train.rendering.edge_sampling import OutlineSampler
from curio_train.rendering.instances import Instances
from curio_train.rendering.pixels import ImageLocation
from curio_train.rendering.shadows import Blockers
from curio_train.rendering.tracing import LayerTracer, RayQuery

LocationsOfRays = Callable[[Any], tuple[ImageLocation, Any]]
"""From the numbers of rays to their places and whether they are inside the image."""


@dataclass(frozen=True)
class RenderSettings:
    """Renderer settings that hold for every batch: image size, samples, ambient light, ground."""

    mi: ModuleType
    """Mitsuba."""
    dr: ModuleType
    """Dr.Jit."""
    tracer: LayerTracer
    """Traces and shades rays."""
    outlines: OutlineSampler
    """Finds and samples silhouettes."""
    width: int
    """Width of the images, pixels."""
    height: int
    """Height of the images, pixels."""
    num_slots: int
    """Slots of objects in an image, some of which may be empty."""
    samples_per_pixel: int
    """Rays a pixel and slot."""
    outline_samples: int
    """Points on each object's outline."""
    object_shadows: bool
    """Whether objects stand in each other's light."""


@dataclass(frozen=True)
class View:
    """The part of a batch that is traced at once."""

    images: tuple[int, int]
    """First and last + 1 image."""
    query: RayQuery
    """What is asked of the rays."""
    bounds: ImageBounds
    """Bounds of the part's instances."""
    camera: Any
    """Float, see :class:`Instances`."""
    key: Any
    """Key of all random numbers of the batch, UInt32."""
    appearance: Any = None
    """Float, see :class:`Instances`, or None."""

    @property
    def num_images(self) -> int:
        """Number of images in this part of the batch."""
        return self.images[1] - self.images[0]


@dataclass(frozen=True)
class Hits:
    """Rays that hit their object."""

    lane: Any
    """Numbers of the rays."""
    at: LocationsOfRays
    """Locations in the image that the rays pass through."""
    record: Any
    """Faces hit, Mitsuba's preliminary intersections."""
    occlusion: Occlusion
    """Occlusion of the samples that the rays belong to."""
    blockers: Blockers | None
    """What keeps the light from the hits, or None."""


class Launch:
    """Rays over one part of a batch, in front of its backgrounds (flat [b, c, h, w])."""

    def __init__(self, settings: RenderSettings, view: View, background: Any) -> None:
        self.set, self.view, self.background = settings, view, background
        self.mi, self.dr = settings.mi, settings.dr

    def trace(
        self, instances: Instances, lane: Any, at: LocationsOfRays, per_group: int, num_groups: int
    ) -> Hits | None:
        """Trace rays and keep those that hit; None where none does. Samples come in groups, see :class:`Occlusion`."""
        mi, dr, tracer = self.mi, self.dr, self.set.tracer
        if len(lane) == 0:
            return None
        location, inside = at(lane)
        ray = instances.ray(location.instance, location.x, location.y)
        record = tracer.intersect(instances, location.instance, ray, inside, self.view.query.reach_from_m)
        dr.eval(record)
        hit = dr.compress(record.is_valid())
        if len(hit) == 0:
            return None
        record, lane = dr.gather(type(record), record, hit), dr.gather(mi.UInt32, lane, hit)
        dr.eval(record, lane)
        occlusion = Occlusion(mi, dr, self.set.num_slots, per_group)
        if self.set.num_slots > 1:
            occlusion.build(at(lane)[0], record.t, num_groups)
        return Hits(lane, at, record, occlusion, self._blockers(instances, at(lane)[0], record.t))

    def _blockers(self, instances: Instances, location: ImageLocation, depth_m: Any) -> Blockers | None:
        if not self.set.object_shadows or self.set.num_slots == 1 or not self.view.query.shaded:
            return None
        blockers = Blockers(self.mi, self.dr, self.set.tracer, self.set.num_slots)
        blockers.find(instances.detached(), location, depth_m)
        return blockers

    def contributions(self, instances: Instances, hits: Hits) -> tuple[ImageLocation, list[Any]]:
        """Contribution of each hit to the colour of its sample, weight · (color − background), one array a channel."""
        location, _ = hits.at(hits.lane)
        lit = hits.blockers.lit(instances, location) if hits.blockers else 1.0
        colors = self.view.query.colors(self.set.tracer, instances, location, hits.record, lit)
        weight = hits.occlusion.weight(instances, location, hits.record.t)
        behind = self.channels_at(self.background, location.pixel)
        return location, [weight * (color - under) for color, under in zip(colors, behind, strict=True)]

    def weighed(self, instances: Instances, hits: Hits, adjoint: Any) -> tuple[ImageLocation, Any]:
        """The contributions' scalar product with the adjoint at their pixels."""
        location, colors = self.contributions(instances, hits)
        return location, sum(c * w for c, w in zip(colors, self.channels_at(adjoint, location.pixel), strict=True))

    def channels_at(self, flat: Any, pixel: Any) -> list[Any]:
        """The channels of a flat [b, c, h, w] array at pixels."""
        return [self.dr.gather(self.mi.Float, flat, i) for i in self.planes(pixel)]

    def planes(self, pixel: Any) -> list[Any]:
        """Indices of a pixel's channels in a flat [b, c, h, w] array."""
        area, channels = self.set.width * self.set.height, self.view.query.channels
        first = pixel + (pixel // area) * ((channels - 1) * area)
        return [first + channel * area for channel in range(channels)]

    def nearest_pixel(self, image: Any, x: Any, y: Any, margin: float = 0.0) -> tuple[Any, Any]:
        """The pixel at (x, y), or the nearest one inside; and whether (x, y) is inside, give or take a margin."""
        mi, dr, width, height = self.mi, self.dr, self.set.width, self.set.height
        column, line = dr.floor(x + 0.5), dr.floor(y + 0.5)
        inside = (column >= -margin) & (column < width + margin) & (line >= -margin) & (line < height + margin)
        column, line = mi.UInt32(dr.clip(column, 0, width - 1)), mi.UInt32(dr.clip(line, 0, height - 1))
        return (image * height + line) * width + column, inside
