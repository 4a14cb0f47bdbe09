"""One launch for a batch: rays of all images and slots through the static scene, shaded by the mesh's own BSDF.

A *row* is one object in one image (image · num_slots + slot). A *layer* is what one row's rays see: coverage, depth
along the optical axis in metres, and sRGB colour.
"""

from dataclasses import dataclass
from types import ModuleType
from typing import Any

ROW_SIZE = 19
"""Values a row: origin 3, direction matrix 9, light 3, linear albedo 3, confidence 1 (see :class:`Rows`)."""


@dataclass(frozen=True)
class Rows:
    """What a ray must know of its object; Dr.Jit arrays with one entry a row.

    With ``cam_from_obj`` = (R, t) and the static scene's placement (center c, radius s, offset w), the camera stands at
    ``origin = −(Rᵀt + c) / s + w`` and a camera ray d goes along ``matrix · d`` with ``matrix = Rᵀ / s``; with d.z = 1
    the ray parameter is the depth in metres.

    Attributes:
        origin: 3 floats, scene frame.
        matrix: 9 floats, row-major.
        light: 3 floats, object frame, towards the light, its length the strength.
        albedo: 3 floats, linear.
        confidence: 1 float in [0, 1].
    """

    origin: list[Any]
    matrix: list[Any]
    light: list[Any]
    albedo: list[Any]
    confidence: Any

    @property
    def all(self) -> list[Any]:
        """The 19 arrays in their order."""
        return [*self.origin, *self.matrix, *self.light, *self.albedo, self.confidence]


@dataclass
class Layer:
    """What rays saw. Attributes: alpha (coverage · confidence), depth_m, rgb (sRGB, 3 arrays)."""

    alpha: Any
    depth_m: Any
    rgb: list[Any]


def rows_from(columns: list[Any]) -> Rows:
    """Rows of 19 columns."""
    return Rows(columns[0:3], columns[3:12], columns[12:15], columns[15:18], columns[18])


class LayerTracer:
    """Traces and shades rays; the same code for primal images, gradients and silhouettes."""

    def __init__(self, mi: ModuleType, dr: ModuleType, scene: Any, ambient: float) -> None:
        self.mi, self.dr, self.scene = mi, dr, scene
        self.ambient = ambient

    def rays(self, rows: Rows, row: Any, dx: Any, dy: Any) -> Any:
        """Rays of the given rows through camera directions (dx, dy, 1)."""
        take = self._taker(row)
        m = [take(v) for v in rows.matrix]
        direction = self.mi.Vector3f(
            m[0] * dx + m[1] * dy + m[2], m[3] * dx + m[4] * dy + m[5], m[6] * dx + m[7] * dy + m[8]
        )
        return self.mi.Ray3f(self.mi.Point3f(*[take(v) for v in rows.origin]), direction)

    def intersect(self, ray: Any, active: Any = True) -> Any:
        """The detached preliminary intersection: which face, where on it."""
        with self.dr.suspend_grad():
            return self.scene.ray_intersect_preliminary(self.dr.detach(ray), coherent=True, active=active)

    def shade(self, rows: Rows, row: Any, ray: Any, hit: Any) -> Layer:
        """Colour of hits: albedo · (ambient + max(0, n·l)), encoded to sRGB."""
        mi, dr = self.mi, self.dr
        take = self._taker(row)
        valid = hit.is_valid()
        flags = mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame | mi.RayFlags.UV
        surface = hit.compute_surface_interaction(ray, flags, valid)
        normal = mi.Normal3f(surface.sh_frame.n)
        # Meshes wound inside out or open show their back: both sides shade alike.
        normal = dr.select(dr.dot(surface.n, ray.d) > 0, -normal, normal)
        light = mi.Vector3f(*[take(v) for v in rows.light])
        radiance = self.ambient + dr.maximum(0, dr.dot(normal, light))
        albedo = surface.bsdf(ray).eval_diffuse_reflectance(surface, valid)
        rgb = [srgb_from_linear(dr, dr.select(valid, albedo[i] * take(rows.albedo[i]) * radiance, 0)) for i in range(3)]
        alpha = dr.select(valid, take(rows.confidence), 0)
        return Layer(alpha, dr.select(valid, hit.t, dr.inf), rgb)

    def _taker(self, row: Any) -> Any:
        # Neighbouring rays belong to one row: gradients are summed within the vector before they reach memory.
        return lambda values: self.dr.gather(type(values), values, row, mode=self.dr.ReduceMode.Local)


def srgb_from_linear(dr: ModuleType, linear: Any) -> Any:
    """Encode linear light to sRGB (IEC 61966-2-1), clipped to [0, 1] like a camera."""
    linear = dr.clip(linear, 0, 1)
    curve = 1.055 * dr.power(dr.maximum(linear, 1e-4), 1 / 2.4) - 0.055
    return dr.select(linear <= 0.0031308, 12.92 * linear, curve)
