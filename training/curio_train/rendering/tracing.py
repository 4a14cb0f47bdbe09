"""Traces rays against their instance's object in the static scene and shades hits by the mesh's own BSDF."""

from abc import ABC, abstractmethod
from types import ModuleType
from typing import Any

from curio_train.rendering.bounds import NEAR_M
from curio_train.rendering.instances import Instances
from curio_train.rendering.materials import APPEARANCE_SIZE, Appearance
from curio_train.rendering.pixels import ImageLocation

SPHERE = 1.001
"""Radius of the objects' bounding spheres in the static scene, with room for rounding."""


class LayerTracer:
    """Traces and shades rays; the same code for primal images, gradients and silhouettes."""

    def __init__(self, mi: ModuleType, dr: ModuleType, scene: Any, ambient: float) -> None:
        self.mi, self.dr, self.scene = mi, dr, scene
        self.ambient = ambient
        shapes = scene.shapes()
        self.only_shape = shapes[0] if len(shapes) == 1 else None

    def near(self, instances: Instances, instance: Any, ray: Any) -> Any:
        """Whether rays pass the instances' bounding spheres."""
        dr = self.dr
        arm = instances.sphere_center(instance) - ray.o
        return dr.squared_norm(arm) - dr.square(dr.dot(arm, ray.d)) / dr.squared_norm(ray.d) <= SPHERE * SPHERE

    def intersect(self, instances: Instances, instance: Any, ray: Any, active: Any, nearest: float) -> Any:
        """Detached preliminary intersection with the instance's object: which face, where on it, at which depth.

        Only the part of the ray within the object's bounding sphere is traced. The other objects of the static scene
        are then out of reach, and float32 is spent on the object instead of on the way there. Nothing before the ray
        parameter ``nearest`` is seen.
        """
        dr = self.dr
        with dr.suspend_grad():
            origin, direction = dr.detach(ray.o), dr.detach(ray.d)
            inverse = dr.rcp(dr.squared_norm(direction))
            middle = dr.dot(instances.sphere_center(instance) - origin, direction) * inverse
            reach = SPHERE * dr.sqrt(inverse)
            start = dr.maximum(middle - reach, nearest)
            part = self.mi.Ray3f(dr.fma(direction, start, origin), direction)
            part.maxt = middle + reach - start
            hit = self.scene.ray_intersect_preliminary(part, coherent=True, active=active & (part.maxt > 0))
            hit.t += start
            return hit

    def shade(self, instances: Instances, instance: Any, ray: Any, hit: Any, lit: Any) -> list[Any]:
        """Colour of hits in sRGB, 3 arrays: albedo · (ambient + lit · max(0, n·l)), encoded."""
        mi, dr = self.mi, self.dr
        surface, bsdf = self._surface(ray, hit)
        normal = mi.Normal3f(surface.sh_frame.n)
        # Meshes wound inside out or open show their back: both sides shade alike.
        normal = dr.select(dr.dot(surface.n, ray.d) > 0, -normal, normal)
        own, light = bsdf.eval_diffuse_reflectance(surface), instances.light(instance)
        if instances.appearance is None:
            radiance, shine = self.ambient + lit * dr.maximum(0, dr.dot(normal, light)), 0.0
        else:
            appearance = Appearance.of_values(
                mi, dr, self.scene, instances.appearance_values(instance, APPEARANCE_SIZE)
            )
            grain, normal = appearance.roughened(surface.p - instances.sphere_center(instance), normal)
            radiance, lit = appearance.radiance(self.ambient, lit, surface, normal, light)
            radiance, shine = grain * radiance, appearance.highlight(lit, -ray.d, normal, light)
        return [
            srgb_from_linear(dr, own[i] * albedo * radiance + shine)
            for i, albedo in enumerate(instances.albedo(instance))
        ]

    def _surface(self, ray: Any, hit: Any) -> tuple[Any, Any]:
        """Hit points and their BSDF; a single shape is queried directly, which saves a lookup."""
        flags = self.mi.RayFlags.Minimal | self.mi.RayFlags.ShadingFrame | self.mi.RayFlags.UV
        if self.only_shape is not None:
            return self.only_shape.compute_surface_interaction(ray, hit, flags), self.only_shape.bsdf()
        surface = hit.compute_surface_interaction(ray, flags)
        return surface, surface.bsdf(ray)


class RayQuery(ABC):
    """Traces rays through pixels against instances and shades the hits."""

    channels: int
    """Number of channels of the image."""
    shaded: bool
    """Whether light matters to what is shown."""
    reach_from_m: float
    """Nothing nearer to the rays' origins is seen."""

    @abstractmethod
    def instances(self, values: Any, camera: Any) -> Instances:
        """Instances as they are looked at, of packed values."""

    @abstractmethod
    def colors(
        self, tracer: LayerTracer, instances: Instances, location: ImageLocation, hit: Any, lit: Any
    ) -> list[Any]:
        """Colours of hits, one array a channel; ``lit`` is the fraction of the light that reaches them."""


class Objects(RayQuery):
    """Shows the objects themselves."""

    channels = 3
    shaded = True
    reach_from_m = NEAR_M

    def __init__(self, mi: ModuleType, dr: ModuleType) -> None:
        self.mi, self.dr = mi, dr

    def instances(self, values: Any, camera: Any) -> Instances:
        """Seen by the camera."""
        return Instances(self.mi, self.dr, values, camera)

    def colors(
        self, tracer: LayerTracer, instances: Instances, location: ImageLocation, hit: Any, lit: Any
    ) -> list[Any]:
        """Shaded by the mesh's own BSDF."""
        return tracer.shade(
            instances, location.instance, instances.ray(location.instance, location.x, location.y), hit, lit
        )


def srgb_from_linear(dr: ModuleType, linear: Any) -> Any:
    """Encode linear light to sRGB (IEC 61966-2-1), clipped to [0, 1] like a camera."""
    linear = dr.clip(linear, 0, 1)
    curve = 1.055 * dr.power(dr.maximum(linear, 1e-4), 1 / 2.4) - 0.055
    return dr.select(linear <= 0.0031308, 12.92 * linear, curve)
