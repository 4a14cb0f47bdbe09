"""What rays must know of the objects they look at: one *row* an object and image, packed for Dr.Jit.

Row = image · num_slots + slot.
"""

from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any, Self

INSTANCE_SIZE = 19
"""Differentiable values a row: origin 3, matrix 9, light 3, linear albedo 3, confidence 1."""

CAMERA_SIZE = 7
"""Other values a row: fx, fy, cx, cy in pixels, and the bounding sphere's centre in the scene frame, 3."""


@dataclass(frozen=True)
class Instances:
    """The rows of one part of a batch.

    With ``cam_from_obj`` = (R, t) and the static scene's placement (center c, radius s, offset w), the camera stands at
    ``origin = −(Rᵀt + c) / s + w`` and a camera ray d goes along ``matrix · d`` with ``matrix = Rᵀ / s``; with d.z = 1
    the ray parameter is the depth in metres.

    Attributes:
        mi: Mitsuba.
        dr: Dr.Jit.
        values: Float [rows · ROW_SIZE], row after row.
        camera: Float [rows · CAMERA_SIZE], row after row.
        finish: Float [rows · FINISH_SIZE], row after row, or None: all surfaces are dull and smooth.
    """

    mi: ModuleType
    dr: ModuleType
    values: Any
    camera: Any
    finish: Any = None

    def detached(self) -> Self:
        """The same values, without gradients."""
        return replace(self, values=self.dr.detach(self.values))

    def origin(self, row: Any) -> Any:
        """Camera centre, scene frame."""
        return self.mi.Point3f(*self._take(row, 0, 3))

    def turned(self, row: Any, vector: Any) -> Any:
        """Camera frame to scene frame: ``matrix · vector``."""
        x, y, z = vector
        m = self._take(row, 3, 9)
        return self.mi.Vector3f(*[m[3 * i] * x + m[3 * i + 1] * y + m[3 * i + 2] * z for i in range(3)])

    def ray(self, row: Any, x: Any, y: Any) -> Any:
        """What looks at the object through pixel (x, y), scene frame; the ray parameter is the depth in metres."""
        return self.mi.Ray3f(self.origin(row), self.turned(row, self.direction(row, x, y)))

    def toward(self, row: Any, point: Any) -> Any:
        """From a point to where it is looked at from, scene frame."""
        return self.origin(row) - point

    def to_camera(self, row: Any, point: Any) -> Any:
        """Scene frame to camera frame, metres: q = s² matrixᵀ (p − origin), as p = matrix · q + origin."""
        dr, m = self.dr, self._take(row, 3, 9)
        d = point - self.origin(row)
        scale = 1 / (dr.square(m[0]) + dr.square(m[1]) + dr.square(m[2]))
        return scale * self.mi.Vector3f(*[m[i] * d.x + m[3 + i] * d.y + m[6 + i] * d.z for i in range(3)])

    def direction_to_camera(self, row: Any, vector: Any) -> Any:
        """Turn a direction of the object's frame to the camera's: s matrixᵀ = R."""
        dr, m = self.dr, self._take(row, 3, 9)
        scale = dr.rsqrt(dr.square(m[0]) + dr.square(m[1]) + dr.square(m[2]))
        return scale * self.mi.Vector3f(
            *[m[i] * vector.x + m[3 + i] * vector.y + m[6 + i] * vector.z for i in range(3)]
        )

    def light(self, row: Any) -> Any:
        """Towards the light in the object's frame, its length the strength."""
        return self.mi.Vector3f(*self._take(row, 12, 3))

    def albedo(self, row: Any) -> list[Any]:
        """Linear albedo that multiplies the mesh's own."""
        return self._take(row, 15, 3)

    def confidence(self, row: Any) -> Any:
        """In [0, 1]."""
        return self._take(row, 18, 1)[0]

    def finish_values(self, row: Any, count: int) -> list[Any]:
        """Of :attr:`finish`."""
        return [self.dr.gather(self.mi.Float, self.finish, row * count + i) for i in range(count)]

    def project(self, row: Any, point: Any) -> tuple[Any, Any]:
        """Camera frame to pixels."""
        fx, fy, cx, cy = self._intrinsics(row)
        return fx * point.x / point.z + cx, fy * point.y / point.z + cy

    def direction(self, row: Any, x: Any, y: Any) -> tuple[Any, Any, float]:
        """The camera-frame point of depth 1 that is seen at pixel (x, y)."""
        fx, fy, cx, cy = self._intrinsics(row)
        return (x - cx) / fx, (y - cy) / fy, 1.0

    def sphere_center(self, row: Any) -> Any:
        """Of the object's bounding sphere, scene frame; its radius is 1."""
        return self.mi.Point3f(
            *[self.dr.gather(self.mi.Float, self.camera, row * CAMERA_SIZE + 4 + i) for i in range(3)]
        )

    def _intrinsics(self, row: Any) -> list[Any]:
        return [self.dr.gather(self.mi.Float, self.camera, row * CAMERA_SIZE + i) for i in range(4)]

    def _take(self, row: Any, first: int, count: int) -> list[Any]:
        # Neighbouring rays belong to one row: gradients are summed within the vector before they reach memory.
        local = self.dr.ReduceMode.Local
        start = row * INSTANCE_SIZE + first
        return [self.dr.gather(self.mi.Float, self.values, start + i, mode=local) for i in range(count)]
