"""The same scene as stock Mitsuba sees it, one scene an image.

The reference in tests, the baseline in benchmarks, and the path tracer behind pictures for people.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from curio_train.meshes.meshes import Mesh
from curio_train.rendering.parts import linear_from_srgb, mesh_shape
from curio_train.rendering.topology import adjacency

OPENCV_AXES = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Mitsuba's cameras look along z like OpenCV's, with x to the left and y up."""


@dataclass(frozen=True)
class PosedMesh:
    """An object before the camera."""

    mesh: Mesh
    """Mesh in its own frame."""
    rotation: np.ndarray
    """Cam_from_obj, [3, 3]."""
    translation_m: np.ndarray
    """Cam_from_obj, [3]."""
    color_srgb: tuple[float, ...] = (1.0, 1.0, 1.0)
    """Albedo [3] that multiplies the mesh's own."""
    opacity: float | None = None
    """Opacity in [0, 1], seen from both sides; None: solid, and its inside is black, as Mitsuba has it by default."""


def sensor(mitsuba: Any, camera_matrix: np.ndarray, width: int, height: int, samples_per_pixel: int) -> dict[str, Any]:
    """Mitsuba's camera and film for an OpenCV pinhole camera at the origin, every difference of the two settled here.

    Mitsuba puts pixel centres at half-integers, looks with x to the left and y up, knows square pixels only (fx = fy),
    and gives the principal point as an offset from the film's centre in film sizes.

    Args:
        mitsuba: The module.
        camera_matrix: K [3, 3], pixels, pixel centres at integers, fx = fy.
        width: Of the image.
        height: Of the image.
        samples_per_pixel: Of the film.
    """
    (fx, _, cx), (_, _, cy), _ = np.asarray(camera_matrix, dtype=np.float64)
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
    return {
        "type": "perspective",
        "fov": float(2 * np.degrees(np.arctan(width / 2 / fx))),
        "fov_axis": "x",
        "principal_point_offset_x": float(0.5 - (cx + 0.5) / width),
        "principal_point_offset_y": float(0.5 - (cy + 0.5) / height),
        "near_clip": 0.001,
        "far_clip": 1000.0,
        "to_world": mitsuba.ScalarTransform4f(OPENCV_AXES),
        "film": {**film, "pixel_format": "rgba", "sample_border": False},
        "sampler": {"type": "independent", "sample_count": samples_per_pixel},
    }


def emitters(ambient: float, light: np.ndarray) -> dict[str, Any]:
    """The light of albedo · (ambient + max(0, n·l)): ``constant`` of radiance ``ambient``, ``directional`` of π|l|."""
    strength = float(np.linalg.norm(light))
    sun = {
        "type": "directional",
        "direction": [float(-v) for v in light],
        "irradiance": {"type": "rgb", "value": np.pi * strength},
    }
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": ambient}}
    return {"sky": sky, **({"sun": sun} if strength > 0 else {})}


def load_scene(
    mitsuba: Any, objects: Sequence[PosedMesh], camera: Mapping[str, Any], lights: Mapping[str, Any], integrator: Any
) -> Any:
    """The ``mitsuba.Scene`` of posed objects in the camera's frame."""
    shapes = {f"object_{i}": _posed_shape(mitsuba, f"object_{i}", item) for i, item in enumerate(objects)}
    return mitsuba.load_dict({"type": "scene", "integrator": integrator, "sensor": camera, **lights, **shapes})


def _posed_shape(mitsuba: Any, name: str, item: PosedMesh) -> Any:
    posed = item.mesh.vertices_m @ item.rotation.T + item.translation_m
    middle, size = item.translation_m, np.abs(item.mesh.vertices_m).max()
    neighbours = adjacency((posed - middle) / size, item.mesh.faces)
    tint = linear_from_srgb(np.array(item.color_srgb))
    return mesh_shape(mitsuba, name, item.mesh, posed, neighbours, tint, item.opacity)
