"""Where in an image can an object be? A polytope around its mesh, projected, bounds it from eight sides (numpy)."""

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import HalfspaceIntersection

NEAR_M = 1e-3
"""Nothing nearer to the camera's plane is projected."""

_MARGIN = 1e-3  # of the bounding radius: keeps the polytope of a flat mesh solid, and rounding harmless

DIRECTIONS = ((1, 0), (0, 1), (1, 1), (1, -1), (2, 1), (2, -1), (1, 2), (1, -2))


def enclosing_polytope(vertices: np.ndarray) -> np.ndarray:
    """Corners [n, 3] of a polytope with 42 sides at most that encloses ``vertices`` [v, 3] closely."""
    normals = np.asarray(trimesh.creation.icosphere(subdivisions=1).vertices)
    size = np.abs(vertices).max()
    support = np.concatenate([(vertices @ part.T).max(0) for part in np.array_split(normals, 7)])
    inside = vertices.mean(0)
    return np.asarray(HalfspaceIntersection(np.c_[normals, -(support + _MARGIN * size)], inside).intersections)


@dataclass(frozen=True)
class ImageBounds:
    """Bounds of each instance in its image."""

    low: np.ndarray
    """Float32 [instances, 8], smallest value of a·x + b·y over the object for each (a, b) in ``DIRECTIONS``; pixels."""
    high: np.ndarray
    """Float32 [instances, 8], largest."""
    rectangle: np.ndarray
    """Int64 [instances, 4], x0, y0, x1, y1 in pixels, the end exclusive; empty where nothing can be seen."""

    @property
    def num_pixels(self) -> np.ndarray:
        """[instances], pixels of the rectangles, at least as many as are traced."""
        return np.prod(self.rectangle[:, 2:] - self.rectangle[:, :2], axis=1)

    def part(self, first: int, last: int) -> "ImageBounds":
        """Some of the instances."""
        return ImageBounds(self.low[first:last], self.high[first:last], self.rectangle[first:last])


def project_bounds(corners_m: np.ndarray, intrinsics: np.ndarray, width: int, height: int) -> ImageBounds:
    """Bounds of convex bodies.

    Args:
        corners_m: [instances, n, 3], camera frame, not necessarily finite.
        intrinsics: [instances, 4]: fx, fy, cx, cy in pixels, pixel centres at integers.
        width: Of the image.
        height: Of the image.

    Returns:
        Empty rectangles for bodies behind the camera, out of frame or not finite; the whole image for a body that the
        camera's plane cuts.
    """
    finite = np.asarray(np.isfinite(corners_m).all((1, 2)))
    corners = np.where(finite[:, None, None], corners_m, 1.0)
    depth = corners[:, :, 2]
    before = np.asarray((depth > NEAR_M).all(1))
    behind = np.asarray((depth <= NEAR_M).all(1)) | ~finite
    safe = np.where(before[:, None], depth, 1.0)[:, :, None]
    pixels = corners[:, :, :2] / safe * intrinsics[:, None, :2] + intrinsics[:, None, 2:]
    along = pixels @ np.array(DIRECTIONS, dtype=pixels.dtype).T
    low = np.where(before[:, None], along.min(1), -np.inf)
    high = np.where(before[:, None], along.max(1), np.inf)
    size = np.array([width, height])
    start = np.clip(np.ceil(low[:, :2] - 0.5), 0, size)
    end = np.clip(np.floor(high[:, :2] + 0.5) + 1, start, size)
    end[behind] = start[behind] = 0
    return ImageBounds(low.astype(np.float32), high.astype(np.float32), np.hstack([start, end]).astype(np.int64))
