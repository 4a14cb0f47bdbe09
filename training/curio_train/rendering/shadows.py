"""Shadows of parallel light: on the ground, where a shadow is one more projection of the object, and on other objects.

On the ground the estimators are those of the objects themselves with another way of seeing (:class:`ShadowRows`): a
pixel sees a point of the ground, and the ray goes on from there towards the light; a silhouette edge, as seen from the
light, is carried along the light to the ground and then into the image. So a shadow has interior and silhouette
gradients by pose, light and confidence. Confidence attenuates a shadow as it does its object.

Shadows on other objects are rays from what was hit through the other slots. Their gradient knows confidence; that of
their moving border is left out: it is a small part of the image, and its border lies on curved surfaces.
"""

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from curio_train.rendering.ground import Ground
from curio_train.rendering.instances import Instances
from curio_train.rendering.pixels import ImageLocation
from curio_train.rendering.tracing import LayerTracer, RayQuery

_LOWEST_SUN = 1e-3
"""Sine of the elevation below which there are no shadows: they would be endless."""

_FAR = 1e6  # where parallel light comes from, in radii of the objects


def fallen(corners_m: np.ndarray, light: np.ndarray, ground: Ground) -> np.ndarray:
    """Shadows of points [instances, n, 3] on the ground, camera frame; NaN without light from above.

    Args:
        corners_m: Camera frame.
        light: [instances, 3], towards the light, camera frame.
        ground: The plane.
    """
    up = np.asarray(ground.up, dtype=light.dtype)
    climb = light @ up
    high = climb > _LOWEST_SUN * np.linalg.norm(light, axis=1)
    height = corners_m @ up + np.float32(ground.camera_height_m)
    along = np.where(high, 1 / np.where(high, climb, 1), np.nan)
    return np.asarray(corners_m - (height * along[:, None])[..., None] * light[:, None])


@dataclass(frozen=True)
class ShadowRows(Instances):
    """Rows as the ground sees them along the light."""

    plane: Any = None
    """The ground's normal in the camera frame, and the camera's height above it, 4 opaque floats."""

    def ray(self, instance: Any, x: Any, y: Any) -> Any:
        """Ray to the light from the ground point seen at pixel (x, y); pixels above the horizon have none."""
        dr, (*up, height) = self.dr, self.plane
        seen = self.mi.Vector3f(*self.direction(instance, x, y))
        fall = -(up[0] * seen.x + up[1] * seen.y + up[2] * seen.z)
        point = seen * dr.select(fall > 0, height / dr.maximum(fall, 1e-9), dr.nan)
        return self.mi.Ray3f(self.origin(instance) + self.turned(instance, point), self.light(instance))

    def toward(self, instance: Any, point: Any) -> Any:
        """Direction from a point to the light, which is far away."""
        return self.dr.normalize(self.light(instance)) * _FAR

    def to_camera(self, instance: Any, point: Any) -> Any:
        """Scene frame to camera frame, carried along the light to the ground; behind the camera where no light is."""
        dr, (*up, height) = self.dr, self.plane
        location, light = super().to_camera(instance, point), self.direction_to_camera(instance, self.light(instance))
        climb = up[0] * light.x + up[1] * light.y + up[2] * light.z
        lit = climb > _LOWEST_SUN * dr.norm(light)
        along = (up[0] * location.x + up[1] * location.y + up[2] * location.z + height) / dr.select(lit, climb, 1)
        return dr.select(lit, location - along * light, self.mi.Vector3f(0, 0, -1))


class GroundShadows(RayQuery):
    """Shows how much of the light each hit keeps from the ground."""

    channels = 1
    shaded = False
    reach_from_m = 0.0

    def __init__(self, mi: ModuleType, dr: ModuleType, ground: Ground) -> None:
        self.mi, self.dr = mi, dr
        self.plane = [dr.opaque(mi.Float, float(v)) for v in (*ground.up, ground.camera_height_m)]

    def instances(self, values: Any, camera: Any) -> ShadowRows:
        """Rows in the light of this ground."""
        return ShadowRows(self.mi, self.dr, values, camera, plane=self.plane)

    def colors(
        self, tracer: LayerTracer, instances: Instances, location: ImageLocation, hit: Any, lit: Any
    ) -> list[Any]:
        """The fraction of the light that a hit keeps: 1, whatever was hit."""
        return [1.0]


class Blockers:
    """Which other objects of the image stand between hits and the light."""

    def __init__(self, mi: ModuleType, dr: ModuleType, tracer: LayerTracer, num_slots: int) -> None:
        self.mi, self.dr, self.tracer, self.num_slots = mi, dr, tracer, num_slots
        self.table: Any = None

    def find(self, instances: Instances, location: ImageLocation, depth_m: Any) -> None:
        """Trace a ray from every hit through every other slot whose bounding sphere it passes."""
        mi, dr, n = self.mi, self.dr, self.num_slots
        num_hits = len(depth_m)
        lane = dr.arange(mi.UInt32, num_hits * n)
        instance, ray = self._ray(instances, location, depth_m, lane)
        own = instance == dr.gather(mi.UInt32, location.instance, lane // n)
        kept = dr.compress(~own & self.tracer.near(instances, instance, ray))
        self.table = dr.zeros(mi.Float, num_hits * n)
        if len(kept) > 0:
            instance, ray = self._ray(instances, location, depth_m, kept)
            record = self.tracer.intersect(instances, instance, ray, mi.Bool(True), 0.0)
            dr.scatter(self.table, dr.select(record.is_valid(), mi.Float(1), 0), kept)
        dr.eval(self.table)

    def lit(self, instances: Instances, location: ImageLocation) -> Any:
        """Fraction of the light that reaches each hit: what the confidences of all that is in between let through."""
        mi, dr, n = self.mi, self.dr, self.num_slots
        first, image = dr.arange(mi.UInt32, len(self.table) // n) * n, location.instance // n
        lit = mi.Float(1)
        for slot in range(n):
            lit *= 1 - instances.confidence(image * n + slot) * dr.gather(mi.Float, self.table, first + slot)
        return lit

    def _ray(self, instances: Instances, location: ImageLocation, depth_m: Any, lane: Any) -> tuple[Any, Any]:
        """Row and ray of a lane (hit, slot), in that slot's frame."""
        mi, dr, n = self.mi, self.dr, self.num_slots
        hit = lane // n
        owner = dr.gather(mi.UInt32, location.instance, hit)
        instance = owner // n * n + lane - hit * n
        x, y, depth = (dr.gather(mi.Float, v, hit) for v in (location.x, location.y, depth_m))
        point = mi.Vector3f(*instances.direction(owner, x, y)) * depth
        return instance, mi.Ray3f(
            instances.origin(instance) + instances.turned(instance, point), instances.light(instance)
        )
