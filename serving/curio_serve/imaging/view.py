"""A frame, or a region of it, as the camera a model was trained for would see it; and poses turned back.

A model knows one pinhole camera K* and one image size. Turning a camera about its centre changes its picture by a
homography alone, whatever the scene's depth: a direction ``d`` in the frame's camera is ``R d`` in the turned one, so
an undistorted pixel ``p`` of the frame appears at

    p* ~ K* R K⁻¹ p        and a pose found there is turned back with Rᵀ.

*Choice of R*: the smallest rotation that brings the ray through the region's centre onto the ray through the centre of
the canonical image. Where a frame comes from the training camera itself, K = S K* with S the scaling between the two
sizes, these two rays of a whole frame are equal and R is exactly the identity: the frame is merely resized. (Turning
the optical axis there instead would shift such a frame by the distance of its principal point from its centre.)

*Size of a region*: a homography of this kind keeps angles, so the canonical image always shows the field of view of K*,
and nothing else keeps the model's depths true: magnifying by s would make an object at z look like one at z/s, with a
perspective it never has there. A region therefore says *where to look*, not how much to see: one narrower than the
canonical field of view is seen with its surroundings, of a wider one the middle is seen. A whole frame is the region
over the frame. The centre of a region that reaches over the edge is moved into the frame.

*2D worlds* have no K*: the region is resized to the canonical size, and positions are (x, y, 0) in widths of the image
from its centre.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from curio_serve.errors import CameraError
from curio_serve.imaging.camera import PinholeCamera, scaling
from curio_serve.imaging.rotation import smallest_rotation

Array = np.ndarray
_MIN_RAY_DEPTH = 0.05  # cosine to the optical axis: 87 degrees
_MAX_AIMS = 32  # where a camera distorts, each holds two numbers a pixel


class Region(NamedTuple):
    """A rectangle in pixels of the full-size frame; x = 0, width = 640 covers exactly a frame 640 pixels wide."""

    x: float
    y: float
    width: float
    height: float

    def overlaps(self, width: int, height: int) -> bool:
        """Whether it has any pixel of a frame of that size."""
        return self.x < width and self.y < height and self.x + self.width > 0 and self.y + self.height > 0


@dataclass(frozen=True, eq=False)
class CanonicalCamera:
    """What a model was trained for: the size of its input, and K* [3, 3] (None in 2D worlds).

    Attributes:
        is_default: A frame without K is taken as seen by K* scaled to the frame's size.
    """

    width: int
    height: int
    matrix: Array | None = None
    is_default: bool = False

    @cached_property
    def focal_lengths(self) -> tuple[float, float]:
        """Of K*, pixels: x and y."""
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
        """K* scaled to a frame's size, where the model allows that as a default."""
        return _default_camera(self, width, height) if self.matrix is not None and self.is_default else None


@lru_cache(_MAX_AIMS)
def _default_camera(canonical: CanonicalCamera, width: int, height: int) -> PinholeCamera:
    """Kept, so that it is one camera that sends many frames."""
    return PinholeCamera(scaling(width / canonical.width, height / canonical.height) @ np.asarray(canonical.matrix))


class View(ABC):
    """One region as the model sees it.

    Poses are few and small, so they are turned back as plain numbers: numpy's calls cost more than these sums.

    Attributes:
        image: uint8 RGB [canonical height, canonical width, 3].
    """

    image: Array

    @abstractmethod
    def translation(self, found: Sequence[float]) -> Sequence[float]:
        """A position (3) of the model as a position in the frame's camera (or widths of the frame)."""

    @abstractmethod
    def turn(self, found: Sequence[Sequence[float]]) -> Sequence[float]:
        """A matrix of three rows in the frame's camera, row after row: a rotation (9), or a light (3)."""

    @abstractmethod
    def project(self, points: Sequence[Sequence[float]]) -> Sequence[float]:
        """Pixels, x and y in turn, in the full-size frame of points in the frame's camera (or widths of the frame)."""


@dataclass(frozen=True, eq=False)
class _Aim:
    """How a model's camera looks at a region of a camera's frames.

    Attributes:
        canonical_from_cam: Rotation [3, 3].
        cam_from_canonical: Its inverse as plain numbers.
        homography: From pixels of the view to pixels of the frame as averaged down [3, 3]; None where they are the
            same, and where the camera distorts.
        maps: The same for a camera that distorts, as OpenCV's ``remap`` takes it.
    """

    canonical_from_cam: Array
    cam_from_canonical: Sequence[Sequence[float]]
    homography: Array | None = None
    maps: tuple[Array, Array] | None = None

    def image(self, pixels: Array, size: tuple[int, int]) -> Array:
        """What is seen, uint8 RGB of that (width, height)."""
        if self.maps is not None:
            return cv2.remap(pixels, *self.maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return pixels if self.homography is None else _warp(pixels, self.homography, size)


@lru_cache(_MAX_AIMS)
def _aim(
    camera: PinholeCamera,
    canonical: CanonicalCamera,
    frame_size: tuple[int, int],
    pixels_size: tuple[int, int],
    region: Region,
) -> _Aim:
    """Kept, because one camera sends many frames, and these few numbers cost as much as half a warp.

    Args:
        camera: Of the full-size frame.
        canonical: Of the model; with K*.
        frame_size: (width, height) of the full-size frame.
        pixels_size: The same of its pixels as averaged down.
        region: In pixels of the full-size frame.

    Raises:
        CameraError: The view would reach behind the frame's camera.
    """
    size = canonical.width, canonical.height
    x, y = (
        min(max(start + length / 2, 0.0), end) - 0.5
        for start, length, end in zip(region[:2], region[2:], frame_size, strict=True)
    )
    turn = smallest_rotation(camera.ray(x, y), canonical.rays[:, 0])
    if (turn[:, 2] @ canonical.rays).min() < _MIN_RAY_DEPTH:
        raise CameraError(
            "the model's view of this region would reach more than 87 degrees away from the camera's axis; "
            "choose a region nearer the middle of the frame, or check K's focal length"
        )
    matrix = scaling(*np.divide(pixels_size, frame_size)) @ camera.matrix
    if camera.coefficients is not None:
        target = np.asarray(canonical.matrix)
        maps = cv2.initUndistortRectifyMap(matrix, camera.coefficients, turn, target, size, cv2.CV_32FC1)
        return _Aim(turn, turn.T.tolist(), maps=maps)
    homography = matrix @ turn.T @ canonical.inverse
    return _Aim(turn, turn.T.tolist(), None if _changes_nothing(homography, pixels_size, size) else homography)


class PinholeView(View):
    """A region of a frame with K."""

    def __init__(self, image: Array, camera: PinholeCamera, aim: _Aim) -> None:
        self.image = image
        self.canonical_from_cam = aim.canonical_from_cam
        self._cam_from_canonical = aim.cam_from_canonical
        self._camera = camera

    def translation(self, found: Sequence[float]) -> Sequence[float]:
        x, y, z = found
        return [a * x + b * y + c * z for a, b, c in self._cam_from_canonical]

    def turn(self, found: Sequence[Sequence[float]]) -> Sequence[float]:
        columns = list(zip(*found, strict=True))
        return [a * x + b * y + c * z for a, b, c in self._cam_from_canonical for x, y, z in columns]

    def project(self, points: Sequence[Sequence[float]]) -> Sequence[float]:
        return self._camera.pixels(points)


class FlatView(View):
    """A region of a 2D world's frame."""

    def __init__(self, image: Array, region: Region, frame_size: tuple[int, int]) -> None:
        self.image = image
        self._region = region
        self._frame_size = frame_size

    def translation(self, found: Sequence[float]) -> Sequence[float]:
        # From widths of the canonical image to its shares of the region, whose height may be stretched differently.
        region, (width, height) = self._region, self._frame_size
        canonical_height, canonical_width = self.image.shape[:2]
        x = region.x + region.width * (found[0] + 0.5)
        y = region.y + region.height * (found[1] * canonical_width / canonical_height + 0.5)
        return (x - width / 2) / width, (y - height / 2) / width, 0.0

    def turn(self, found: Sequence[Sequence[float]]) -> Sequence[float]:
        return [value for row in found for value in row]

    def project(self, points: Sequence[Sequence[float]]) -> Sequence[float]:
        width, height = self._frame_size
        return [value for x, y, _ in points for value in (x * width + (width - 1) / 2, y * width + (height - 1) / 2)]


class PinholeFrame:
    """A frame with its camera, made ready to be looked at by a model's camera.

    Averaging it down to the model's scale comes first, once for all regions, because the warp itself samples points.
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
            raise CameraError("a 2D model has no camera to look through")
        self._camera, self._canonical = camera, canonical
        x_ratio, y_ratio = (c / f for c, f in zip(canonical.focal_lengths, camera.focal_lengths, strict=True))
        self._pixels = _average_down(pixels, self.width * x_ratio, self.height * y_ratio)

    def look(self, region: Region) -> PinholeView:
        """The region as the model's camera sees it.

        Raises:
            CameraError: The view would reach behind the frame's camera.
        """
        canonical, pixels = self._canonical, self._pixels
        height, width = pixels.shape[:2]
        aim = _aim(self._camera, canonical, (self.width, self.height), (width, height), region)
        return PinholeView(aim.image(pixels, (canonical.width, canonical.height)), self._camera, aim)


class FlatFrame:
    """A frame for a model of a 2D world."""

    def __init__(self, pixels: Array, canonical: CanonicalCamera, reduction: int = 1) -> None:
        self.width, self.height = pixels.shape[1] * reduction, pixels.shape[0] * reduction
        self._pixels, self._canonical = pixels, canonical

    def look(self, region: Region) -> FlatView:
        """The region resized to the model's input; beyond the frame its edge pixels go on."""
        size = self._canonical.width, self._canonical.height
        x_ratio, y_ratio = size[0] / region.width, size[1] / region.height
        pixels = _average_down(self._pixels, self.width * x_ratio, self.height * y_ratio)
        to_pixels = scaling(pixels.shape[1] / self.width, pixels.shape[0] / self.height)
        shift = np.array([[1, 0, region.x], [0, 1, region.y], [0, 0, 1]])
        homography = to_pixels @ shift @ scaling(1 / x_ratio, 1 / y_ratio)
        same = _changes_nothing(homography, (pixels.shape[1], pixels.shape[0]), size)
        return FlatView(pixels if same else _warp(pixels, homography, size), region, (self.width, self.height))


def _average_down(pixels: Array, width: float, height: float) -> Array:
    """Pixels averaged over areas down to that size; sides that would grow stay as they are."""
    size = (
        min(pixels.shape[1], max(1, round(width))),
        min(pixels.shape[0], max(1, round(height))),
    )
    if size == (pixels.shape[1], pixels.shape[0]):
        return pixels
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)


def _changes_nothing(pixels_from_view: Array, pixels_size: tuple[int, int], view_size: tuple[int, int]) -> bool:
    """Whether a homography between two images is the identity."""
    same_size = pixels_size == view_size
    return same_size and bool(np.abs(pixels_from_view / pixels_from_view[2, 2] - np.eye(3)).max() < 1e-6)


def _warp(pixels: Array, pixels_from_view: Array, size: tuple[int, int]) -> Array:
    """Image of ``size`` whose pixel p shows ``pixels`` at the homography's ``pixels_from_view`` p."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpPerspective(pixels, pixels_from_view, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
