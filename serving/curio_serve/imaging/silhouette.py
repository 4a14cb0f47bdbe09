"""Silhouettes of meshes: what a pose covers in a frame, without a renderer."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from curio_serve.imaging.camera import PinholeCamera

_NEAREST_M = 1e-3  # triangles that reach behind this plane are left out: they project to anywhere
_SUBPIXEL_BITS = 4
_FARTHEST_PX = 1e5


@dataclass(frozen=True)
class Surface:
    """Triangles of an object in its own frame."""

    vertices_m: NDArray[np.float64]
    """[num_vertices, 3]."""
    faces: NDArray[np.int64]
    """[num_faces, 3] rows of ``vertices_m``."""


def silhouette(
    surface: Surface,
    rotation: NDArray[np.float64],
    translation_m: NDArray[np.float64],
    camera: PinholeCamera,
    width: int,
    height: int,
) -> NDArray[np.uint8]:
    """The pixels that a surface covers.

    Args:
        surface: Of the object.
        rotation: [3, 3] from the object's frame to the camera's.
        translation_m: [3] the object's origin in the camera's frame.
        camera: Of the frame.
        width: Of the frame, in pixels.
        height: Of the frame, in pixels.

    Returns:
        uint8 [height, width]: 1 where it does, else 0.
    """
    covered = np.zeros((height, width), np.uint8)
    points_m = surface.vertices_m @ rotation.T + translation_m
    corners_m = points_m[surface.faces]
    faces = surface.faces[(corners_m[..., 2] > _NEAREST_M).all(axis=1)]
    if not len(faces) or not np.isfinite(points_m).all():
        return covered
    projected, _ = cv2.projectPoints(points_m, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion))
    fixed = np.rint(np.clip(projected.reshape(-1, 2), -_FARTHEST_PX, _FARTHEST_PX) * (1 << _SUBPIXEL_BITS))
    for triangle in fixed.astype(np.int32)[faces]:
        cv2.fillConvexPoly(covered, triangle, 1, cv2.LINE_8, _SUBPIXEL_BITS)
    return covered
