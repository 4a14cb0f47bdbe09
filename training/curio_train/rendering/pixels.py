"""Which pixels can an object touch: projected bounding spheres and the lists of pixels to trace (numpy)."""

from dataclasses import dataclass

import numpy as np

MARGIN_PX = 1.0


@dataclass(frozen=True)
class PixelList:
    """Pixels to trace, grouped by row (one row an image and slot), row after row.

    Attributes:
        row: uint32 [num_pixels], image · num_slots + slot.
        x: float32 [num_pixels], column.
        y: float32 [num_pixels], line.
        index: uint32 [num_pixels], (image · height + y) · width + x.
    """

    row: np.ndarray
    x: np.ndarray
    y: np.ndarray
    index: np.ndarray


def sphere_bounds(
    centers_m: np.ndarray, radii_m: np.ndarray, intrinsics: np.ndarray, width: int, height: int
) -> np.ndarray:
    """Pixel rectangles that hold the projections of spheres.

    Args:
        centers_m: [rows, 3], camera frame.
        radii_m: [rows].
        intrinsics: [rows, 4]: fx, fy, cx, cy in pixels, pixel centres at integers.
        width: Of the image.
        height: Of the image.

    Returns:
        int64 [rows, 4]: x0, y0, x1, y1, the end exclusive; empty (x1 <= x0) for a sphere behind the camera or out of
        frame, the whole image for a sphere around the camera.
    """
    x, y, z = centers_m.astype(np.float64).T
    radii = radii_m.astype(np.float64)
    in_front = z > radii * 1.001
    bounds = np.empty((len(z), 4))
    size = (width, height)
    for axis, lateral in enumerate((x, y)):
        # Tangents from the origin to a circle in the plane of this axis and z.
        square = np.where(in_front, z**2 - radii**2, 1.0)
        root = radii * np.sqrt(np.maximum(lateral**2 + square, 0.0))
        focal, center = intrinsics[:, axis], intrinsics[:, 2 + axis]
        low = focal * (lateral * z - root) / square + center
        high = focal * (lateral * z + root) / square + center
        bounds[:, axis] = np.where(in_front, np.clip(np.floor(low - MARGIN_PX), 0, size[axis]), 0)
        bounds[:, 2 + axis] = np.where(in_front, np.clip(np.ceil(high + MARGIN_PX) + 1, 0, size[axis]), size[axis])
    hopeless = ~np.isfinite(centers_m).all(1) | (z < -radii)
    bounds[hopeless] = 0
    return bounds.astype(np.int64)


def list_pixels(
    centers_m: np.ndarray, radii_m: np.ndarray, intrinsics: np.ndarray, num_slots: int, width: int, height: int
) -> PixelList:
    """All pixels that the bounding spheres can touch; arguments as in :func:`sphere_bounds`.

    ``num_slots`` is the number of rows an image.
    """
    bounds = sphere_bounds(centers_m, radii_m, intrinsics, width, height)
    x0, y0, x1, y1 = bounds.T
    widths, heights = np.maximum(x1 - x0, 0), np.maximum(y1 - y0, 0)
    counts = widths * heights
    row = np.repeat(np.arange(len(bounds), dtype=np.uint32), counts)
    starts = np.repeat((np.cumsum(counts) - counts).astype(np.int32), counts)
    local = np.arange(len(row), dtype=np.int32) - starts
    row_width = np.maximum(widths, 1).astype(np.int32)[row]
    line = local // row_width
    x = (local - line * row_width).astype(np.float32) + x0.astype(np.float32)[row]
    y = line.astype(np.float32) + y0.astype(np.float32)[row]
    keep = _near_sphere(x, y, row, centers_m, radii_m, intrinsics)
    row, x, y = row[keep], x[keep], y[keep]
    image = row // np.uint32(num_slots)
    index = (image * np.uint32(height) + y.astype(np.uint32)) * np.uint32(width) + x.astype(np.uint32)
    return PixelList(row, x, y, index)


def _near_sphere(
    x: np.ndarray, y: np.ndarray, row: np.ndarray, centers_m: np.ndarray, radii_m: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    """Whether a pixel's ray passes within the sphere, widened by the margin: (d·c)² ≥ |d|² (|c|² − r²)."""
    fx, fy, cx, cy = intrinsics.astype(np.float32).T
    center = centers_m.astype(np.float32)
    radius = (radii_m + MARGIN_PX * 1.5 * np.abs(centers_m[:, 2]) / np.minimum(fx, fy)).astype(np.float32)
    power = np.nan_to_num((center**2).sum(1) - radius**2, nan=0.0, posinf=0.0)
    dx = (x - cx[row]) / fx[row]
    dy = (y - cy[row]) / fy[row]
    along = dx * center[row, 0] + dy * center[row, 1] + center[row, 2]
    return along * along >= (dx * dx + dy * dy + 1) * power[row]
