"""Layers: what the rays of one row see of their object, through the static scene, shaded by the mesh's own BSDF."""

from abc import ABC, abstractmethod
from types import ModuleType
from typing import Any

from curio_train.rendering.bounds import NEAR_M
from curio_train.rendering.instances import Instances
from curio_train.rendering.materials import APPEARANCE_SIZE, Appearance
from curio_train.rendering.pixels import Place

SPHERE = 1.001
"""Radius of the objects' bounding spheres in the static scene, with room for rounding."""


class LayerTracer:
    """Traces and shades rays; the same code for primal images, gradients and silhouettes."""

    def __init__(self, mi: ModuleType, dr: ModuleType, scene: Any, ambient: float) -> None:
        self.mi, self.dr, self.scene = mi, dr, scene
        self.ambient = ambient
        shapes = scene.shapes()
        self.only_shape = shapes[0] if len(shapes) == 1 else None

    def near(self, rows: Instances, row: Any, ray: Any) -> Any:
        """Whether rays pass the rows' bounding spheres."""
        dr = self.dr
        arm = rows.sphere_center(row) - ray.o
        return dr.squared_norm(arm) - dr.square(dr.dot(arm, ray.d)) / dr.squared_norm(ray.d) <= SPHERE * SPHERE

    def intersect(self, rows: Instances, row: Any, ray: Any, active: Any, nearest: float) -> Any:
        """The detached preliminary intersection with the row's own object: which face, where on it, at which depth.

        Only the part of the ray within the object's bounding sphere is traced. The other objects of the static scene
        are then out of reach, and float32 is spent on the object instead of on the way there. Nothing before the ray
        parameter ``nearest`` is seen.
        """
        dr = self.dr
        with dr.suspend_grad():
            origin, direction = dr.detach(ray.o), dr.detach(ray.d)
            inverse = dr.rcp(dr.squared_norm(direction))
            middle = dr.dot(rows.sphere_center(row) - origin, direction) * inverse
            reach = SPHERE * dr.sqrt(inverse)
            start = dr.maximum(middle - reach, nearest)
            part = self.mi.Ray3f(dr.fma(direction, start, origin), direction)
            part.maxt = middle + reach - start
            hit = self.scene.ray_intersect_preliminary(part, coherent=True, active=active & (part.maxt > 0))
            hit.t += start
            return hit

    def shade(self, rows: Instances, row: Any, ray: Any, hit: Any, lit: Any) -> list[Any]:
        """Colour of hits in sRGB, 3 arrays: albedo · (ambient + lit · max(0, n·l)), encoded."""
        mi, dr = self.mi, self.dr
        surface, bsdf = self._surface(ray, hit)
        normal = mi.Normal3f(surface.sh_frame.n)
        # Meshes wound inside out or open show their back: both sides shade alike.
        normal = dr.select(dr.dot(surface.n, ray.d) > 0, -normal, normal)
        own, light = bsdf.eval_diffuse_reflectance(surface), rows.light(row)
        if rows.finish is None:
            radiance, shine = self.ambient + lit * dr.maximum(0, dr.dot(normal, light)), 0.0
        else:
            finish = Appearance.of_values(mi, dr, self.scene, rows.finish_values(row, APPEARANCE_SIZE))
            grain, normal = finish.roughened(surface.p - rows.sphere_center(row), normal)
            radiance, lit = finish.radiance(self.ambient, lit, surface, normal, light)
            radiance, shine = grain * radiance, finish.highlight(lit, -ray.d, normal, light)
        return [srgb_from_linear(dr, own[i] * albedo * radiance + shine) for i, albedo in enumerate(rows.albedo(row))]

    def _surface(self, ray: Any, hit: Any) -> tuple[Any, Any]:
        """Where rays hit, and the BSDF there; a single shape is asked itself, which saves looking up whose it is."""
        flags = self.mi.RayFlags.Minimal | self.mi.RayFlags.ShadingFrame | self.mi.RayFlags.UV
        if self.only_shape is not None:
            return self.only_shape.compute_surface_interaction(ray, hit, flags), self.only_shape.bsdf()
        surface = hit.compute_surface_interaction(ray, flags)
        return surface, surface.bsdf(ray)


class RayQuery(ABC):
    """What rays through pixels look for, and what they show of it.

    Attributes:
        channels: Of the image.
        reach_from_m: Nothing nearer to the rays' origins is seen.
        shaded: Whether light matters to what is shown.
    """

    channels: int
    shaded: bool
    reach_from_m: float

    @abstractmethod
    def rows(self, values: Any, camera: Any) -> Instances:
        """Rows as they are looked at, of packed values."""

    @abstractmethod
    def colors(self, tracer: LayerTracer, rows: Instances, place: Place, hit: Any, lit: Any) -> list[Any]:
        """What hits look like, one array a channel; ``lit`` is the share of the light that reaches them."""


class Objects(RayQuery):
    """Shows the objects themselves."""

    channels = 3
    shaded = True
    reach_from_m = NEAR_M

    def __init__(self, mi: ModuleType, dr: ModuleType) -> None:
        self.mi, self.dr = mi, dr

    def rows(self, values: Any, camera: Any) -> Instances:
        """Seen by the camera."""
        return Instances(self.mi, self.dr, values, camera)

    def colors(self, tracer: LayerTracer, rows: Instances, place: Place, hit: Any, lit: Any) -> list[Any]:
        """Shaded by the mesh's own BSDF."""
        return tracer.shade(rows, place.row, rows.ray(place.row, place.x, place.y), hit, lit)


def srgb_from_linear(dr: ModuleType, linear: Any) -> Any:
    """Encode linear light to sRGB (IEC 61966-2-1), clipped to [0, 1] like a camera."""
    linear = dr.clip(linear, 0, 1)
    curve = 1.055 * dr.power(dr.maximum(linear, 1e-4), 1 / 2.4) - 0.055
    return dr.select(linear <= 0.0031308, 12.92 * linear, curve)
