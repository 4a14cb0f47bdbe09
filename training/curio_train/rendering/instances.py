"""What rays must know of the objects they are traced against: one *instance* for each object of each image, packed.

Instance number = image · num_slots + slot.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any, Self

VALUES: Mapping[str, int] = {"origin": 3, "matrix": 9, "light": 3, "albedo": 3, "confidence": 1}
"""Differentiable values of an instance, in their order, and how many there are of each."""

CAMERA: Mapping[str, int] = {"intrinsics": 4, "sphere_center": 3}
"""Other values of an instance: fx, fy, cx, cy in pixels; centre of the bounding sphere, scene frame."""

INSTANCE_SIZE, CAMERA_SIZE = sum(VALUES.values()), sum(CAMERA.values())


def _offset(layout: Mapping[str, int], name: str) -> int:
    names = list(layout)
    return sum(layout[before] for before in names[: names.index(name)])


@dataclass(frozen=True)
class Instances:
    """The instances of one part of a batch.

    With ``cam_from_obj`` = (R, t) and the static scene's placement (center c, radius s, offset w), the camera stands at
    ``origin = −(Rᵀt + c) / s + w`` and a camera ray d goes along ``matrix · d`` with ``matrix = Rᵀ / s``; with d.z = 1
    the ray parameter is the depth in metres.
    """

    mi: ModuleType
    """Mitsuba."""
    dr: ModuleType
    """Dr.Jit."""
    values: Any
    """Float [instances · INSTANCE_SIZE], instance after instance, in the order of :data:`VALUES`."""
    camera: Any
    """Float [instances · CAMERA_SIZE], in the order of :data:`CAMERA`."""
    appearance: Any = None
    """Float [instances · APPEARANCE_SIZE]; None: all surfaces are dull and smooth."""

    def detached(self) -> Self:
        """These instances without gradients."""
        return replace(self, values=self.dr.detach(self.values))

    def origin(self, instance: Any) -> Any:
        """Camera centre, scene frame."""
        return self.mi.Point3f(*self._take(instance, "origin"))

    def turned(self, instance: Any, vector: Any) -> Any:
        """Camera frame to scene frame: ``matrix · vector``."""
        x, y, z = vector
        m = self._take(instance, "matrix")
        return self.mi.Vector3f(*[m[3 * i] * x + m[3 * i + 1] * y + m[3 * i + 2] * z for i in range(3)])

    def ray(self, instance: Any, x: Any, y: Any) -> Any:
        """The ray through pixel (x, y), scene frame; its parameter is the depth in metres."""
        return self.mi.Ray3f(self.origin(instance), self.turned(instance, self.direction(instance, x, y)))

    def toward(self, instance: Any, point: Any) -> Any:
        """Direction from a point to the camera, scene frame."""
        return self.origin(instance) - point

    def to_camera(self, instance: Any, point: Any) -> Any:
        """Scene frame to camera frame, metres: q = s² matrixᵀ (p − origin), as p = matrix · q + origin."""
        dr, m = self.dr, self._take(instance, "matrix")
        d = point - self.origin(instance)
        scale = 1 / (dr.square(m[0]) + dr.square(m[1]) + dr.square(m[2]))
        return scale * self.mi.Vector3f(*[m[i] * d.x + m[3 + i] * d.y + m[6 + i] * d.z for i in range(3)])

    def direction_to_camera(self, instance: Any, vector: Any) -> Any:
        """Turn a direction of the object's frame to the camera's: s matrixᵀ = R."""
        dr, m = self.dr, self._take(instance, "matrix")
        scale = dr.rsqrt(dr.square(m[0]) + dr.square(m[1]) + dr.square(m[2]))
        return scale * self.mi.Vector3f(
            *[m[i] * vector.x + m[3 + i] * vector.y + m[6 + i] * vector.z for i in range(3)]
        )

    def light(self, instance: Any) -> Any:
        """Vector towards the light in the object's frame; its length is the strength."""
        return self.mi.Vector3f(*self._take(instance, "light"))

    def albedo(self, instance: Any) -> list[Any]:
        """Linear albedo that multiplies the mesh's own."""
        return self._take(instance, "albedo")

    def confidence(self, instance: Any) -> Any:
        """Confidence in [0, 1]."""
        return self._take(instance, "confidence")[0]

    def appearance_values(self, instance: Any, count: int) -> list[Any]:
        """The values of :attr:`appearance`."""
        return [self.dr.gather(self.mi.Float, self.appearance, instance * count + i) for i in range(count)]

    def project(self, instance: Any, point: Any) -> tuple[Any, Any]:
        """Camera frame to pixels."""
        fx, fy, cx, cy = self._intrinsics(instance)
        return fx * point.x / point.z + cx, fy * point.y / point.z + cy

    def direction(self, instance: Any, x: Any, y: Any) -> tuple[Any, Any, float]:
        """The camera-frame point of depth 1 that is seen at pixel (x, y)."""
        fx, fy, cx, cy = self._intrinsics(instance)
        return (x - cx) / fx, (y - cy) / fy, 1.0

    def sphere_center(self, instance: Any) -> Any:
        """Centre of the object's bounding sphere, scene frame; its radius is 1."""
        return self.mi.Point3f(*self._take_camera(instance, "sphere_center"))

    def _intrinsics(self, instance: Any) -> list[Any]:
        return self._take_camera(instance, "intrinsics")

    def _take_camera(self, instance: Any, name: str) -> list[Any]:
        start = instance * CAMERA_SIZE + _offset(CAMERA, name)
        return [self.dr.gather(self.mi.Float, self.camera, start + i) for i in range(CAMERA[name])]

    def _take(self, instance: Any, name: str) -> list[Any]:
        # Neighbouring rays belong to one instance: gradients are summed within the vector before they reach memory.
        local = self.dr.ReduceMode.Local
        start = instance * INSTANCE_SIZE + _offset(VALUES, name)
        return [self.dr.gather(self.mi.Float, self.values, start + i, mode=local) for i in range(VALUES[name])]
