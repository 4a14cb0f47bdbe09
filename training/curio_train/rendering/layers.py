"""Layers: what the rays of one row see of their object, through the static scene, shaded by the mesh's own BSDF."""

from types import ModuleType
from typing import Any

from curio_train.rendering.bounds import NEAR_M
from curio_train.rendering.rows import Rows

SPHERE = 1.001
"""Radius of the objects' bounding spheres in the static scene, with room for rounding."""


class LayerTracer:
    """Traces and shades rays; the same code for primal images, gradients and silhouettes."""

    def __init__(self, mi: ModuleType, dr: ModuleType, scene: Any, ambient: float) -> None:
        self.mi, self.dr, self.scene = mi, dr, scene
        self.ambient = ambient

    def ray(self, rows: Rows, row: Any, x: Any, y: Any) -> Any:
        """Rays of the given rows through pixels (x, y), scene frame; the ray parameter is the depth in metres."""
        return self.mi.Ray3f(rows.origin(row), rows.turned(row, rows.direction(row, x, y)))

    def near(self, rows: Rows, row: Any, ray: Any) -> Any:
        """Whether rays pass the rows' bounding spheres."""
        dr = self.dr
        arm = rows.sphere_center(row) - ray.o
        return dr.squared_norm(arm) - dr.square(dr.dot(arm, ray.d)) / dr.squared_norm(ray.d) <= SPHERE * SPHERE

    def intersect(self, rows: Rows, row: Any, ray: Any, active: Any) -> Any:
        """The detached preliminary intersection with the row's own object: which face, where on it, at which depth.

        Only the part of the ray within the object's bounding sphere is traced. The other objects of the static scene
        are then out of reach, and float32 is spent on the object instead of on the way there.
        """
        dr = self.dr
        with dr.suspend_grad():
            origin, direction = dr.detach(ray.o), dr.detach(ray.d)
            inverse = dr.rcp(dr.squared_norm(direction))
            middle = dr.dot(rows.sphere_center(row) - origin, direction) * inverse
            reach = SPHERE * dr.sqrt(inverse)
            start = dr.maximum(middle - reach, NEAR_M)
            part = self.mi.Ray3f(dr.fma(direction, start, origin), direction)
            part.maxt = middle + reach - start
            hit = self.scene.ray_intersect_preliminary(part, coherent=True, active=active & (part.maxt > 0))
            hit.t += start
            return hit

    def shade(self, rows: Rows, row: Any, ray: Any, hit: Any) -> list[Any]:
        """Colour of hits in sRGB, 3 arrays: albedo · (ambient + max(0, n·l)), encoded."""
        mi, dr = self.mi, self.dr
        flags = mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame | mi.RayFlags.UV
        surface = hit.compute_surface_interaction(ray, flags)
        normal = mi.Normal3f(surface.sh_frame.n)
        # Meshes wound inside out or open show their back: both sides shade alike.
        normal = dr.select(dr.dot(surface.n, ray.d) > 0, -normal, normal)
        radiance = self.ambient + dr.maximum(0, dr.dot(normal, rows.light(row)))
        own = surface.bsdf(ray).eval_diffuse_reflectance(surface)
        return [srgb_from_linear(dr, own[i] * albedo * radiance) for i, albedo in enumerate(rows.albedo(row))]


def srgb_from_linear(dr: ModuleType, linear: Any) -> Any:
    """Encode linear light to sRGB (IEC 61966-2-1), clipped to [0, 1] like a camera."""
    linear = dr.clip(linear, 0, 1)
    curve = 1.055 * dr.power(dr.maximum(linear, 1e-4), 1 / 2.4) - 0.055
    return dr.select(linear <= 0.0031308, 12.92 * linear, curve)
