"""What a surface looks like beside its colour: gloss, grain, bumps, shadows on itself, light from a second side.

Meshes say little of that, and photographs are full of it. A network that learns from many such surfaces cannot take one
way of shading for the shape (domain randomization, Tobin et al. 2017). Nothing here has a gradient of its own.
"""

import math
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

NUM_WAVES = 3
APPEARANCE_SIZE = 3 + 1 + 2 + 1 + 2 + 4 * NUM_WAVES
"""Values a row: fill light 3, ambient 1, gloss and its sharpness, shadow, grain and bumps, waves 3 and phase each."""

_STRONGEST_FILL = 1.0
_AMBIENT = (0.3, 1.3)
_GLOSSY_SHARE, _STRONGEST_GLOSS, _SHARPNESS = 0.6, 1.0, (4.0, 120.0)
_MOST_GRAIN, _MOST_BUMPS = 0.3, 0.35
_WAVES = (2.0, 14.0)  # radians a radius of the object
_CLEAR = 0.02  # of a radius, that shadow rays begin above the surface


def finishes(
    count: int,
    *,
    fill: np.ndarray | float = 0.0,
    ambient: np.ndarray | float = 1.0,
    gloss: np.ndarray | float = 0.0,
    sharpness: np.ndarray | float = 20.0,
    shadow: np.ndarray | float = 0.0,
    grain: np.ndarray | float = 0.0,
    bumps: np.ndarray | float = 0.0,
    waves: np.ndarray | float = 0.0,
) -> Float[Tensor, "count 1 size"]:
    """Finishes for :class:`~curio_train.rendering.renderer.Renderer`; without arguments a dull and smooth surface.

    Args:
        count: Number of images.
        fill: Second light [count, 3], towards it in the camera's frame, its length the strength; it casts no shadow.
        ambient: [count, 1], what the renderer's ambient radiance is multiplied by.
        gloss: [count, 1], strength of the light's reflection.
        sharpness: [count, 1], exponent of its fall-off.
        shadow: [count, 1], fraction of the light that the object keeps from itself.
        grain: [count, 1], amplitude of the logarithm of what waves do to the albedo.
        bumps: [count, 1], by how much waves tilt the normal.
        waves: [count, NUM_WAVES, 4], their vectors in radians a radius of the object, and their phases.
    """
    parts = [np.broadcast_to(fill, (count, 3))]
    parts += [np.broadcast_to(value, (count, 1)) for value in (ambient, gloss, sharpness, shadow, grain, bumps)]
    parts.append(np.broadcast_to(waves, (count, NUM_WAVES, 4)).reshape(count, -1))
    return torch.from_numpy(np.concatenate(parts, axis=1)).float()[:, None]


def random_appearances(count: int, random: np.random.Generator) -> Float[Tensor, "count 1 size"]:
    """Finishes of any kind."""
    one = (count, 1)
    directions = _unit(random.normal(size=(count, 3)))
    vectors = _unit(random.normal(size=(count, NUM_WAVES, 3))) * log_uniform(*_WAVES, (count, NUM_WAVES, 1), random)
    return finishes(
        count,
        fill=directions * random.uniform(0, _STRONGEST_FILL, one),
        ambient=log_uniform(*_AMBIENT, one, random),
        gloss=random.uniform(0, _STRONGEST_GLOSS, one) * (random.random(one) < _GLOSSY_SHARE),
        sharpness=log_uniform(*_SHARPNESS, one, random),
        shadow=random.integers(0, 2, one),
        grain=random.uniform(0, _MOST_GRAIN, one),
        bumps=random.uniform(0, _MOST_BUMPS, one),
        waves=np.concatenate([vectors, random.uniform(0, 2 * math.pi, (count, NUM_WAVES, 1))], axis=-1),
    )


def in_object_frame(appearance: Tensor, rotation: Float[Tensor, "batch slots 3 3"]) -> Tensor:
    """Finishes whose fill light is turned from the camera's frame to the objects'."""
    fill = (rotation.transpose(-1, -2) @ appearance[..., :3, None])[..., 0]
    return torch.cat([fill, appearance[..., 3:]], dim=-1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def log_uniform(low: float, high: float, shape: tuple[int, ...], random: np.random.Generator) -> np.ndarray:
    """Numbers between two whose logarithms are evenly spread."""
    return np.exp(random.uniform(math.log(low), math.log(high), shape))


@dataclass(frozen=True)
class Appearance:
    """Appearance of the instances that rays hit; see :func:`random_appearances`."""

    mi: ModuleType
    """Mitsuba."""
    dr: ModuleType
    """Dr.Jit."""
    scene: Any
    """Scene in which surfaces shade themselves."""
    fill: Any
    """Vector of the second light, in the objects' frames."""
    ambient: Any
    gloss: Any
    sharpness: Any
    shadow: Any
    grain: Any
    bumps: Any
    """One value a hit."""
    waves: list[tuple[Any, Any]]
    """Vector and phase of each."""

    @staticmethod
    def of_values(mi: ModuleType, dr: ModuleType, scene: Any, values: list[Any]) -> "Appearance":
        """Build from :data:`APPEARANCE_SIZE` arrays, in the order of :func:`random_appearances`."""
        ambient, gloss, sharpness, shadow, grain, bumps, *waves = values[3:]
        each = [(mi.Vector3f(*waves[first : first + 3]), waves[first + 3]) for first in range(0, 4 * NUM_WAVES, 4)]
        fill = mi.Vector3f(*values[:3])
        return Appearance(mi, dr, scene, fill, ambient, gloss, sharpness, shadow, grain, bumps, each)

    def roughened(self, point: Any, normal: Any) -> tuple[Any, Any]:
        """Factor on the albedo, and the normal, of points given from the object's middle, in its radii."""
        mi, dr = self.mi, self.dr
        height, slope = mi.Float(0), mi.Vector3f(0)
        for along, phase in self.waves:
            sine, cosine = dr.sincos(dr.dot(along, point) + phase)
            height += sine
            slope += cosine * along * dr.rcp(dr.maximum(dr.norm(along), 1e-6))
        return dr.exp(self.grain * height), mi.Normal3f(dr.normalize(normal - self.bumps * slope))

    def radiance(self, ambient: float, lit: Any, surface: Any, normal: Any, light: Any) -> tuple[Any, Any]:
        """Irradiance of the surface by ambient light, by the light and by the second light; and the lit fraction."""
        mi, dr = self.mi, self.dr
        with dr.suspend_grad():
            side = dr.select(dr.dot(surface.n, light) < 0, -1.0, 1.0)
            start = dr.detach(surface.p) + _CLEAR * side * dr.detach(surface.n)
            ray = mi.Ray3f(start, dr.normalize(dr.detach(light)))
            ray.maxt = 2.0
            hidden = self.scene.ray_test(ray, active=self.shadow > 0)
        lit = lit * dr.select(hidden, 1 - self.shadow, 1.0)
        facing = lit * dr.maximum(0, dr.dot(normal, light)) + dr.maximum(0, dr.dot(normal, self.fill))
        return self.ambient * ambient + facing, lit

    def highlight(self, lit: Any, towards_camera: Any, normal: Any, light: Any) -> Any:
        """Reflection of the light itself (Blinn 1977)."""
        dr = self.dr
        strength = dr.norm(light)
        half = dr.normalize(light / dr.maximum(strength, 1e-6) + dr.normalize(towards_camera))
        facing = dr.maximum(dr.dot(normal, half), 1e-4)
        return self.gloss * lit * strength * dr.power(facing, self.sharpness)
