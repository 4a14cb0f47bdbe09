"""Layers: what the rays of one row see of their object, through the static scene, shaded by the mesh's own BSDF."""

from types import ModuleType
from typing import Any

from curio_train.rendering.rows import Rows


class LayerTracer:
    """Traces and shades rays; the same code for primal images, gradients and silhouettes."""

    def __init__(self, mi: ModuleType, dr: ModuleType, scene: Any, ambient: float) -> None:
        self.mi, self.dr, self.scene = mi, dr, scene
        self.ambient = ambient

    def ray(self, rows: Rows, row: Any, x: Any, y: Any) -> Any:
        """Rays of the given rows through pixels (x, y), scene frame; the ray parameter is the depth in metres."""
        return self.mi.Ray3f(rows.origin(row), rows.turned(row, rows.direction(row, x, y)))

    def near(self, rows: Rows, row: Any, x: Any, y: Any) -> Any:
        """Whether the rays through pixels (x, y) pass the rows' bounding spheres."""
        dr = self.dr
        arm = rows.sphere_center(row) - rows.origin(row)
        along = rows.turned(row, rows.direction(row, x, y))
        return dr.squared_norm(arm) - dr.square(dr.dot(arm, along)) / dr.squared_norm(along) <= 1.0001

    def intersect(self, ray: Any, active: Any) -> Any:
        """The detached preliminary intersection: which face, where on it."""
        with self.dr.suspend_grad():
            return self.scene.ray_intersect_preliminary(self.dr.detach(ray), coherent=True, active=active)

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
