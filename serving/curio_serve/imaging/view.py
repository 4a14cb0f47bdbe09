"""Warps a frame, or a region of it, to the camera that a model was trained for, and rotates poses back.

A model knows one pinhole camera K* and one image size. Rotating a camera about its centre changes its image by a
homography alone, whatever the scene's depth: a direction ``d`` in the frame's camera is ``R d`` in the rotated one, so
an undistorted pixel ``p`` of the frame appears at

    p* ~ K* R K⁻¹ p        and a pose found there is rotated back with Rᵀ.

*Choice of R*: the smallest rotation that brings the ray through the region's centre onto the ray through the centre of
the canonical image. Where a frame comes from the training camera itself, K = S K* with S the scaling between the two
sizes, these two rays of a whole frame are equal and R is exactly the identity: the frame is merely resized. (Turning
the optical axis there instead would shift such a frame by the distance of its principal point from its centre.)

*Size of a region*: a homography of this kind keeps angles, so the canonical image always shows the field of view of K*,
and nothing else keeps the model's depths true: magnifying by s would make an object at z look like one at z/s, with a
perspective it never has there. A region therefore sets the *direction* of the crop, not its size: a region narrower
than the canonical field of view is seen with its surroundings; of a wider one, only the middle is seen. A whole frame
is the region that covers it. The centre of a region that reaches over the edge is moved into the frame.

*2D worlds* have no K*: the region is resized to the canonical size, and positions are (x, y, 0) in widths of the image
from its centre.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple, Protocol

import cv2
import numpy as np

from curio_serve.errors import CameraError
from curio_serve.imaging.camera import PinholeCamera, scaling
from curio_serve.imaging.rotation import smallest_rotation

MOSTLY_SEARCHED = 0.9
"""Fraction of a frame; users are told where a model sees less of it."""

Array = np.ndarray
_MIN_RAY_DEPTH = 0.05  # cosine to the optical axis: 87 degrees
_GRID = 100  # places along each side of a frame at which it is asked what a model sees of it
_MAX_WARPS = 32  # where a camera distorts, each holds two numbers a pixel


class Region(NamedTuple):
    """A rectangle in pixels of the full-size frame; x = 0, width = 640 covers exactly a frame 640 pixels wide."""

    x: float
    y: float
    width: float
    height: float

    def overlaps(self, width: int, height: int) -> bool:
        """Whether the rectangle has a pixel in common with a frame of that size."""
        return self.x < width and self.y < height and self.x + self.width > 0 and self.y + self.height > 0


@dataclass(frozen=True, eq=False)
class CanonicalCamera:
    """The camera that a model was trained for."""

    width: int
    """Width of the model's input, pixels."""
    height: int
    """Height of the model's input, pixels."""
    matrix: Array | None = None
    """K* [3, 3], pixels; None in 2D worlds."""
    is_default: bool = False
    """Whether K* scaled to the frame's size stands in for the K that a frame comes without."""

    @cached_property
    def focal_lengths(self) -> tuple[float, float]:
        """Focal lengths (x, y) of K*, pixels."""
        matrix = np.asarray(self.matrix)
        return float(matrix[0, 0]), float(matrix[1, 1])

    @cached_property
    def inverse(self) -> Array:
        """K*⁻¹ [3, 3]."""
        return np.linalg.inv(np.asarray(self.matrix))

    @cached_property
    def rays(self) -> Array:
        """Unit directions [3, 5] to the middle of the image and to its corners."""
        right, bottom = self.width - 1.0, self.height - 1.0
        pixels = [(right / 2, bottom / 2), (0, 0), (right, 0), (0, bottom), (right, bottom)]
        rays = self.inverse @ np.array([(x, y, 1.0) for x, y in pixels]).T
        return rays / np.linalg.norm(rays, axis=0)

    def for_frame(self, width: int, height: int) -> PinholeCamera | None:
        """K* scaled to a frame's size, if the model allows that as a default."""
        return _default_camera(self, width, height) if self.matrix is not None and self.is_default else None


@lru_cache(_MAX_WARPS)
def _default_camera(canonical: CanonicalCamera, width: int, height: int) -> PinholeCamera:
    """One camera object for all frames of a size, so that its warps are cached, too."""
    return PinholeCamera(scaling(width / canonical.width, height / canonical.height) @ np.asarray(canonical.matrix))


class Crop(Protocol):
    """One region as the model sees it, and the way back to the frame.

    Poses are few and small, so they are rotated as plain numbers: numpy's calls cost more than these sums.
    """

    image: Array
    """uint8 RGB [canonical height, canonical width, 3]."""

    def translation(self, found: Sequence[float]) -> Sequence[float]:
        """A position (3) from the model, in the frame's camera, metres; in 2D worlds, in widths of the frame."""

    def rotate(self, found: Sequence[Sequence[float]]) -> Sequence[float]:
        """A matrix of three rows in the frame's camera, row after row: a rotation (9 values), or a light (3)."""

    def project(self, points: Sequence[Sequence[float]]) -> Sequence[float]:
        """Full-size pixels, x and y in turn, of points in the frame's camera (in 2D worlds, widths of the frame)."""


@dataclass(frozen=True, eq=False)
class _CanonicalWarp:
    """The map from pixels of a camera's frames to a model's input."""

    canonical_from_cam: Array
    """Rotation [3, 3]."""
    homography: Array | None = None
    """From pixels of the crop to pixels of the frame as averaged down [3, 3]; None: they are equal, or see ``maps``."""
    maps: tuple[Array, Array] | None = None
    """For a camera that distorts: x and y of the frame's pixels, as OpenCV's ``remap`` takes them."""

    def __call__(self, pixels: Array, size: tuple[int, int]) -> Array:
        """The warped image, uint8 RGB of that (width, height)."""
        if self.maps is not None:
            return cv2.remap(pixels, *self.maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return pixels if self.homography is None else _warp(pixels, self.homography, size)


@lru_cache(_MAX_WARPS)
def _canonical_warp(
    camera: PinholeCamera,
    canonical: CanonicalCamera,
    frame_size: tuple[int, int],
    pixels_size: tuple[int, int],
    region: Region,
) -> _CanonicalWarp:
    """Cached, because one camera sends many frames, and these few numbers cost as much as half a warp.

    Args:
        camera: Of the full-size frame.
        canonical: Of the model; with K*.
        frame_size: (width, height) of the full-size frame.
        pixels_size: (width, height) of the frame as averaged down.
        region: In pixels of the full-size frame.

    Raises:
        CameraError: The crop would reach behind the frame's camera.
    """
    size = canonical.width, canonical.height
    x, y = (
        min(max(start + length / 2, 0.0), end) - 0.5
        for start, length, end in zip(region[:2], region[2:], frame_size, strict=True)
    )
    rotation = smallest_rotation(camera.ray(x, y), canonical.rays[:, 0])
    if not (rotation[:, 2] @ canonical.rays).min() >= _MIN_RAY_DEPTH:
        raise CameraError(
            "the model's view of this region would reach more than 87 degrees away from the camera's axis; "
            "choose a region nearer the middle of the frame, or check K's focal length"
        )
    matrix = scaling(*np.divide(pixels_size, frame_size)) @ camera.matrix
    if camera.coefficients is not None:
        target = np.asarray(canonical.matrix)
        maps = cv2.initUndistortRectifyMap(matrix, camera.coefficients, rotation, target, size, cv2.CV_32FC1)
        return _CanonicalWarp(rotation, maps=maps)
    homography = matrix @ rotation.T @ canonical.inverse
    return _CanonicalWarp(rotation, None if _is_identity(homography, pixels_size, size) else homography)


@lru_cache(_MAX_WARPS)
def searched_fraction(camera: PinholeCamera, canonical: CanonicalCamera, width: int, height: int) -> float:
    """The part of a whole frame that a model is shown, 0 to 1; of a frame that shows more than K*, the middle.

    Args:
        camera: Of the frame.
        canonical: Of the model; with K*.
        width: Of the frame, pixels.
        height: Of the frame, pixels.
    """
    canonical_from_cam = smallest_rotation(camera.ray((width - 1) / 2, (height - 1) / 2), canonical.rays[:, 0])
    places = (np.arange(_GRID) + 0.5) / _GRID
    columns, rows = np.meshgrid(places * width - 0.5, places * height - 0.5)
    grid = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2)
    slopes = cv2.undistortPoints(grid, camera.matrix, camera.coefficients)[:, 0]
    rays = np.column_stack([slopes, np.ones(len(slopes))])
    found = rays @ (np.asarray(canonical.matrix) @ canonical_from_cam).T
    pixels = found[:, :2] / found[:, 2:] + 0.5
    is_seen = (found[:, 2] > 0) & ((pixels > 0) & (pixels < (canonical.width, canonical.height))).all(axis=1)
    return float(is_seen.mean())


def undistort(pixels: Array, camera: PinholeCamera) -> Array:
    """A frame as a camera of the same K without distortion takes it; beyond its edge, the edge pixels continue.

    Args:
        pixels: uint8 RGB [height, width, 3].
        camera: Of the frame.
    """
    if camera.coefficients is None:
        return pixels
    size = pixels.shape[1], pixels.shape[0]
    maps = cv2.initUndistortRectifyMap(camera.matrix, camera.coefficients, None, camera.matrix, size, cv2.CV_32FC1)
    return cv2.remap(pixels, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


class PinholeCrop(Crop):
    """A region of a frame with K."""

    def __init__(self, image: Array, camera: PinholeCamera, canonical_from_cam: Array) -> None:
        self.image = image
        self.canonical_from_cam = canonical_from_cam
        self._cam_from_canonical = canonical_from_cam.T.tolist()
        self._camera = camera

    def translation(self, found: Sequence[float]) -> Sequence[float]:
        x, y, z = found
        return [a * x + b * y + c * z for a, b, c in self._cam_from_canonical]

    def rotate(self, found: Sequence[Sequence[float]]) -> Sequence[float]:
        columns = list(zip(*found, strict=True))
        return [a * x + b * y + c * z for a, b, c in self._cam_from_canonical for x, y, z in columns]

    def project(self, points: Sequence[Sequence[float]]) -> Sequence[float]:
        return self._camera.pixels(points)


class FlatCrop(Crop):
    """A region of a 2D world's frame."""

    def __init__(self, image: Array, region: Region, frame_size: tuple[int, int]) -> None:
        self.image = image
        self._region = region
        self._frame_size = frame_size

    def translation(self, found: Sequence[float]) -> Sequence[float]:
        # From widths of the canonical image to fractions of the region, whose height may be stretched differently.
        region, (width, height) = self._region, self._frame_size
        canonical_height, canonical_width = self.image.shape[:2]
        x = region.x + region.width * (found[0] + 0.5)
        y = region.y + region.height * (found[1] * canonical_width / canonical_height + 0.5)
        return (x - width / 2) / width, (y - height / 2) / width, 0.0

    def rotate(self, found: Sequence[Sequence[float]]) -> Sequence[float]:
        return [value for row in found for value in row]

    def project(self, points: Sequence[Sequence[float]]) -> Sequence[float]:
        width, height = self._frame_size
        return [value for x, y, _ in points for value in (x * width + (width - 1) / 2, y * width + (height - 1) / 2)]


class PinholeFrame:
    """A frame with its camera, from which a model's camera takes crops.

    The frame is averaged down to the model's scale once for all regions, because the warp itself samples points.
    """

    def __init__(self, pixels: Array, camera: PinholeCamera, canonical: CanonicalCamera, reduction: int = 1) -> None:
        """Check the camera against the frame and average the pixels down.

        Args:
            pixels: uint8 RGB [height / reduction, width / reduction, 3].
            camera: Of the full-size frame.
            canonical: Of the model; with K*.
            reduction: How much smaller than the frame the pixels are.

        Raises:
            CameraError: The camera cannot have taken this frame.
        """
        self.width, self.height = pixels.shape[1] * reduction, pixels.shape[0] * reduction
        camera.check_frame(self.width, self.height)
        if canonical.matrix is None:
            raise CameraError("the model is of a 2D world and has no camera to warp a frame to")
        self._camera, self._canonical = camera, canonical
        x_ratio, y_ratio = (c / f for c, f in zip(canonical.focal_lengths, camera.focal_lengths, strict=True))
        self._pixels = _average_down(pixels, self.width * x_ratio, self.height * y_ratio)

    def crop(self, region: Region | None = None) -> PinholeCrop:
        """A region, or the whole frame, as the model's camera sees it.

        Raises:
            CameraError: The crop would reach behind the frame's camera.
        """
        canonical, pixels = self._canonical, self._pixels
        frame_size, pixels_size = (self.width, self.height), (pixels.shape[1], pixels.shape[0])
        region = region or Region(0, 0, *frame_size)
        warp = _canonical_warp(self._camera, canonical, frame_size, pixels_size, region)
        return PinholeCrop(warp(pixels, (canonical.width, canonical.height)), self._camera, warp.canonical_from_cam)


class FlatFrame:
    """A frame for a model of a 2D world."""

    def __init__(self, pixels: Array, canonical: CanonicalCamera, reduction: int = 1) -> None:
        self.width, self.height = pixels.shape[1] * reduction, pixels.shape[0] * reduction
        self._pixels, self._canonical = pixels, canonical

    def crop(self, region: Region | None = None) -> FlatCrop:
        """A region, or the whole frame, resized to the model's input; beyond the frame its edge pixels continue."""
        region = region or Region(0, 0, self.width, self.height)
        size = self._canonical.width, self._canonical.height
        x_ratio, y_ratio = size[0] / region.width, size[1] / region.height
        pixels = _average_down(self._pixels, self.width * x_ratio, self.height * y_ratio)
        to_pixels = scaling(pixels.shape[1] / self.width, pixels.shape[0] / self.height)
        offset = np.array([[1, 0, region.x], [0, 1, region.y], [0, 0, 1]])
        homography = to_pixels @ offset @ scaling(1 / x_ratio, 1 / y_ratio)
        same = _is_identity(homography, (pixels.shape[1], pixels.shape[0]), size)
        return FlatCrop(pixels if same else _warp(pixels, homography, size), region, (self.width, self.height))


def _average_down(pixels: Array, width: float, height: float) -> Array:
    """Pixels averaged over areas down to that size; sides that would grow stay as they are."""
    size = (
        min(pixels.shape[1], max(1, round(width))),
        min(pixels.shape[0], max(1, round(height))),
    )
    if size == (pixels.shape[1], pixels.shape[0]):
        return pixels
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)


def _is_identity(pixels_from_crop: Array, pixels_size: tuple[int, int], crop_size: tuple[int, int]) -> bool:
    """Whether a homography between two images of these (width, height) changes nothing."""
    same_size = pixels_size == crop_size
    return same_size and bool(np.abs(pixels_from_crop / pixels_from_crop[2, 2] - np.eye(3)).max() < 1e-6)


def _warp(pixels: Array, pixels_from_crop: Array, size: tuple[int, int]) -> Array:
    """Image of ``size`` whose pixel p shows ``pixels`` at the homography's ``pixels_from_crop`` p."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpPerspective(pixels, pixels_from_crop, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
