"""Pinhole cameras: checks intrinsics, and converts between pixels and rays.

OpenCV's frame: x right, y down, z forward. Pixel centres lie at integer coordinates, so a change of size by s means
p' + 1/2 = s (p + 1/2).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np

from curio_serve.errors import CameraError

Array = np.ndarray
_DISTORTION_SIZES = (0, 4, 5, 8)
_MIN_DEPTH_M = 1e-9
_LEAST_REACHED = 0.85  # of the way to a corner: calibrations say little of the corners themselves
_STEPS_OUTWARD = np.linspace(0, 4, 81)  # times the slope of a corner's ray without distortion
_MIN_FOCAL_WIDTHS, _MAX_FOCAL_WIDTHS = 0.1, 50.0


@dataclass(frozen=True, eq=False)
class PinholeCamera:
    """Intrinsics of the camera that took a frame.

    Raises:
        CameraError: Not finite, singular, not a pinhole matrix, or an impossible focal length, principal point or
            distortion.
    """

    matrix: Array
    """K, float [3, 3], pixels."""
    distortion: tuple[float, ...] = ()
    """OpenCV's k1, k2, p1, p2, k3, k4, k5, k6: none, 4, 5 or 8 values."""
    size: tuple[int, int] | None = None
    """(width, height) in pixels of the frames that K belongs to; None if unknown."""

    def __post_init__(self) -> None:
        """Check what can be checked without the frame."""
        matrix = np.asarray(self.matrix, float)
        object.__setattr__(self, "matrix", matrix)
        _check_matrix(matrix)
        if len(self.distortion) not in _DISTORTION_SIZES or not np.isfinite(self.distortion).all():
            raise CameraError(
                f"distortion has {len(self.distortion)} values {list(self.distortion)}; expected none, 4, 5 or 8 "
                "finite ones in OpenCV's order k1, k2, p1, p2, k3"
            )
        if self.size is not None:
            self.check_frame(*self.size)

    @cached_property
    def coefficients(self) -> Array | None:
        """Distortion as OpenCV takes it; None without distortion."""
        return np.array(self.distortion) if any(self.distortion) else None

    @cached_property
    def focal_lengths(self) -> tuple[float, float]:
        """Pixels: x and y."""
        return self._rows[0][0], self._rows[1][1]

    @cached_property
    def _rows(self) -> list[list[float]]:
        """K as plain numbers."""
        rows: list[list[float]] = self.matrix.tolist()
        return rows

    def check_frame(self, width: int, height: int) -> None:
        """Refuse a frame this camera cannot have taken.

        Raises:
            CameraError: Another size than K belongs to, a principal point outside, an implausible focal length or
                distortion.
        """
        if self.size is not None and self.size != (width, height):
            advice = "calibrate at the size you use, or scale K with the image"
            if self.size == (height, width):
                advice = (
                    "one of the two is rotated by 90 degrees. Viewers rotate images as EXIF says, but K has to belong "
                    "to the pixels as stored: save the images rotated, or rotate K"
                )
            raise CameraError(
                f"K belongs to frames of {self.size[0]}x{self.size[1]}, this one has {width}x{height}; {advice}"
            )
        (fx, _, cx), (_, fy, cy), _ = self._rows
        if not (-0.5 <= cx <= width - 0.5 and -0.5 <= cy <= height - 0.5):
            raise CameraError(
                f"the principal point ({cx:g}, {cy:g}) lies outside the frame of {width}x{height} pixels; "
                "is this K of another size or of another camera?"
            )
        for name, focal, side in (("fx", fx, width), ("fy", fy, height)):
            if not _MIN_FOCAL_WIDTHS <= focal / max(width, height) <= _MAX_FOCAL_WIDTHS:
                raise CameraError(
                    f"{name} = {focal:g} px is implausible for {side} pixels "
                    f"(field of view {np.degrees(2 * np.arctan2(side, 2 * focal)):.3g} degrees); K must be in pixels"
                )
        if self.coefficients is not None:
            _check_distortion(self, width, height)

    def turned(self, quarter_turns: int, width: int, height: int) -> "PinholeCamera":
        """The camera of a frame after clockwise quarter turns of its pixels.

        A quarter turn takes (x, y) to (height - 1 - y, x). The tangential coefficients act as the vector (p2, p1),
        which turns with the image: Brown's model adds r² q + 2 (q·x) x for q = (p2, p1).

        Args:
            quarter_turns: How many.
            width: Of the frame before turning.
            height: Of the frame before turning.
        """
        camera = self
        for _ in range(quarter_turns % 4):
            (fx, _, cx), (_, fy, cy), _ = camera.matrix
            matrix = np.array([[fy, 0, height - 1 - cy], [0, fx, cx], [0, 0, 1]])
            distortion = camera.distortion
            if distortion:
                k1, k2, p1, p2, *rest = distortion
                distortion = (k1, k2, p2, -p1, *rest)
            width, height = height, width
            camera = PinholeCamera(matrix, distortion, camera.size and (width, height))
        return camera

    def reduced(self, reduction: int) -> "PinholeCamera":
        """The camera of frames that were averaged down by a whole number."""
        if reduction == 1:
            return self
        return PinholeCamera(scaling(1 / reduction, 1 / reduction) @ self.matrix, self.distortion)

    def ray(self, x: float, y: float) -> Array:
        """Unit direction [3], camera frame, of the ray through a pixel."""
        (fx, _, cx), (_, fy, cy), _ = self._rows
        slope_x, slope_y = (x - cx) / fx, (y - cy) / fy
        if self.coefficients is not None:
            point = np.array([[[x, y]]], float)
            slope_x, slope_y = cv2.undistortPoints(point, self.matrix, self.coefficients)[0, 0].tolist()
        direction = np.array([slope_x, slope_y, 1.0])
        return direction / math.hypot(slope_x, slope_y, 1.0)

    def project(self, points: Array) -> Array:
        """Pixels [n, 2] of points [n, 3] in the camera frame, metres; NaN for points not in front of the camera."""
        in_front = points[:, 2:] > _MIN_DEPTH_M
        if not in_front.all():
            return np.where(in_front, self.project(np.where(in_front, points, (0.0, 0.0, 1.0))), np.nan)
        if self.coefficients is None:
            seen = points @ self.matrix.T
            return seen[:, :2] / seen[:, 2:]
        found, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), self.matrix, self.coefficients)
        return found[:, 0]

    def pixels(self, points: Sequence[Sequence[float]]) -> list[float]:
        """Pixels of a few points, x and y in turn, as plain numbers: numpy's calls cost more than these sums."""
        if self.coefficients is not None:
            found: list[float] = self.project(np.array(points)).ravel().tolist()
            return found
        (fx, skew, cx), (_, fy, cy), _ = self._rows
        pixels: list[float] = []
        for x, y, z in points:
            pixels += ((fx * x + skew * y) / z + cx, fy * y / z + cy) if z > _MIN_DEPTH_M else (math.nan, math.nan)
        return pixels


def _check_matrix(matrix: Array) -> None:
    if matrix.shape != (3, 3):
        raise CameraError(f"K has shape {list(matrix.shape)}; expected [3, 3]: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    shown = matrix.tolist()
    if not np.isfinite(matrix).all():
        raise CameraError(f"K has values that are not finite: {shown}")
    if (matrix[2] != (0, 0, 1)).any() and (matrix[:, 2] == (0, 0, 1)).all():
        raise CameraError(f"K is {shown}; it is transposed: expected rows [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    if (matrix[2] != (0, 0, 1)).any() or matrix[1, 0] != 0:
        raise CameraError(f"K is {shown}; its last row has to be [0, 0, 1] and the entry below fx 0")
    if matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        raise CameraError(
            f"K is singular or mirrored: fx = {matrix[0, 0]:g}, fy = {matrix[1, 1]:g}; a focal length must be above 0"
        )
    if abs(matrix[0, 1]) > 1e-6 * matrix[0, 0]:
        raise CameraError(f"K has a skew of {matrix[0, 1]:g} px; expected 0: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")


@lru_cache(32)
def _check_distortion(camera: PinholeCamera, width: int, height: int) -> None:
    """Refuse a distortion that moves a point of the border by half the diagonal, or that folds inside the frame."""
    x, y = np.meshgrid([-0.5, (width - 1) / 2, width - 0.5], [-0.5, (height - 1) / 2, height - 0.5])
    border = np.stack([x.ravel(), y.ravel(), np.ones(9)])
    moved_px = np.abs(camera.project((np.linalg.inv(camera.matrix) @ border).T) - border[:2].T).max()
    if not moved_px <= math.hypot(width, height) / 2:
        raise CameraError(
            f"the distortion {list(camera.distortion)} moves pixels of a frame of {width}x{height} by up to "
            f"{moved_px:.3g} px; expected the coefficients k1, k2, p1, p2, k3 of this camera, in OpenCV's order, and K "
            "of frames of this size"
        )
    reached = _reached(camera, border[:, [0, 2, 6, 8]])
    if reached < _LEAST_REACHED:
        raise CameraError(
            f"the distortion {list(camera.distortion)} turns back at {reached:.0%} of the way to a corner of a "
            f"frame of {width}x{height}, beyond which places are seen twice; calibrate again with boards in the "
            "corners, or without k3, unless K is of frames of another size"
        )


def _reached(camera: PinholeCamera, corners: Array) -> float:
    """How far from the principal point a lens sees before its distortion turns back, at worst, fraction of the way.

    Args:
        camera: With distortion.
        corners: Homogeneous pixels [3, n].
    """
    centre, slopes = camera.matrix[:2, 2], (np.linalg.inv(camera.matrix) @ corners)[:2].T
    along = (_STEPS_OUTWARD[:, None, None] * slopes).reshape(-1, 2)
    seen = camera.project(np.concatenate([along, np.ones((len(along), 1))], axis=1))
    seen_px = np.linalg.norm(seen - centre, axis=1).reshape(-1, len(slopes))
    turns_back = np.concatenate([np.diff(seen_px, axis=0) < 0, np.ones((1, len(slopes)), bool)])
    farthest_px = seen_px[turns_back.argmax(axis=0), np.arange(len(slopes))]
    return float((farthest_px / np.linalg.norm(corners[:2].T - centre, axis=1)).min())


def scaling(x_scale: float, y_scale: float) -> Array:
    """Homogeneous [3, 3] matrix of p' + 1/2 = s (p + 1/2), from pixels of one image size to those of another."""
    return np.array([[x_scale, 0, (x_scale - 1) / 2], [0, y_scale, (y_scale - 1) / 2], [0, 0, 1]])
