"""The real camera of photographs: its intrinsics from a file, by the same rule as serving's.

K is in pixels with pixel centres at integer coordinates (OpenCV's and BOP's habit): the image reaches from -0.5 to
width - 0.5. The camera frame is OpenCV's: x right, y down, z forward, metres.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from curio_serve import errors as serving
from curio_serve.files import write_whole
from curio_serve.imaging.camera import PinholeCamera, scaling
from curio_serve.imaging.camera_files import read_camera_file

from curio_train.errors import CameraError

_MATRIX_FORM = "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels"


@dataclass(frozen=True)
class Intrinsics:
    """A real camera, as its file describes it."""

    matrix: np.ndarray
    """K, [3, 3] float64, pixels."""
    width: int
    """Width of the stored image, pixels."""
    height: int
    """Height of the stored image, pixels."""
    distortion: tuple[float, ...] = ()
    """OpenCV's (k1, k2, p1, p2, k3, …): none, 4, 5 or 8 values."""

    @property
    def lens(self) -> tuple[float, ...]:
        """The distortion, in zeros where there is none."""
        return self.distortion or (0.0,) * 5

    def entry(self) -> dict[str, object]:
        """The fields of camera files."""
        matrix, distortion = self.matrix.tolist(), list(self.lens)
        return {"camera_matrix": matrix, "width": self.width, "height": self.height, "distortion": distortion}


def check_matrix(matrix: object, width: int, height: int, where: str = "camera matrix") -> np.ndarray:
    """K as a float64 array [3, 3], or a refusal.

    Args:
        matrix: What claims to be K: rows of numbers, or an array.
        width: Of the image K belongs to, pixels.
        height: Of the image K belongs to, pixels.
        where: File and field, for the message.

    Raises:
        CameraError: It is not the K of a pinhole camera, or not of an image of this size.
    """
    try:
        return PinholeCamera(np.asarray(matrix, dtype=np.float64), (), (width, height)).matrix
    except (TypeError, ValueError) as exc:
        raise CameraError(f"{where}: found {matrix!r}, expected 3x3 numbers {_MATRIX_FORM}") from exc
    except serving.CameraError as exc:
        raise CameraError(f"{where}: {exc}") from exc


def square_matrix(focal_px: float, side: int) -> np.ndarray:
    """K [3, 3] of square pictures of so many pixels a side, whose middle is the principal point."""
    middle = (side - 1) / 2
    return np.array([[focal_px, 0, middle], [0, focal_px, middle], [0, 0, 1]])


def load_intrinsics(path: Path) -> Intrinsics:
    """The one camera of a camera file, with its image size; see ``curio_serve.imaging.camera_files`` for the formats.

    Raises:
        CameraError: The file is missing, describes no camera or several, or does not say the image size.
    """
    try:
        camera = read_camera_file(path).camera
    except serving.CameraError as exc:
        raise CameraError(str(exc)) from exc
    if camera is None:
        raise CameraError(f"camera file {path} has a K for each image; expected one camera for all photographs")
    if camera.size is None:
        raise CameraError(
            f"camera file {path} has no width and height; expected the size of the stored images in pixels"
        )
    return Intrinsics(camera.matrix, *camera.size, camera.distortion)


def save_intrinsics(path: Path, camera: Intrinsics) -> None:
    """Write a camera file, whole or not at all.

    Raises:
        CameraError: The file cannot be written.
    """
    try:
        write_whole(path, json.dumps(camera.entry(), indent=2) + "\n")
    except OSError as exc:
        raise CameraError(f"{path}: cannot be written ({exc.strerror}); name another file: --camera-out") from exc


def scale_matrix(matrix: np.ndarray, from_size: tuple[int, int], to_size: tuple[int, int]) -> np.ndarray:
    """K after resizing the image; sizes are (width, height)."""
    x_scale, y_scale = (to / of for to, of in zip(to_size, from_size, strict=True))
    return scaling(x_scale, y_scale) @ np.asarray(matrix, dtype=np.float64)
