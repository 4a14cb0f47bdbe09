"""The photograph that a scene's objects were found in, as a pinhole camera of the scene's K takes it."""

import functools
import os
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from curio_serve import errors as serving
from curio_serve.files import check_regular, read_file
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.image import MAX_FILE_BYTES, decode
from curio_serve.imaging.video import decoded_frames
from curio_serve.imaging.view import undistort

from curio_train.camera import scale_matrix
from curio_train.data.photographs import read_photograph
from curio_train.drawing.scenes import Scene, file_of
from curio_train.errors import DataError

_MAX_STRETCH = 0.02  # of the ratio of the sides, which rounding changes where a photograph was resized
_RECORDED = re.compile(r"(.+\.mcap)#.+@\d+\.\d+", re.IGNORECASE | re.DOTALL)


def photograph_of(scene: Scene) -> np.ndarray:
    """The pixels of a scene's photograph, [height, width, 3] uint8 sRGB.

    They are rotated as EXIF says where ``curio-detect`` did so, and then undistorted.

    Args:
        scene: With a photograph: an image file, or a frame of a video.

    Raises:
        DataError: The photograph is missing, damaged, of another shape, or a frame of a recording.
    """
    pixels = _as_detected(scene)
    height, width = pixels.shape[:2]
    if abs(width / height * scene.height / scene.width - 1) > _MAX_STRETCH:
        raise DataError(
            f"{scene.photograph}: found {width}x{height} pixels, expected the shape of the frame that was detected in, "
            f"{scene.width}x{scene.height}; is it another file by now?"
        )
    matrix = scale_matrix(scene.camera_matrix, (scene.width, scene.height), (width, height))
    try:
        return undistort(pixels, PinholeCamera(matrix, scene.distortion))
    except serving.CameraError as exc:
        raise DataError(f"{scene.photograph}: its camera is wrong: {exc}") from exc


def is_stored_as_drawn(scene: Scene) -> bool:
    """Whether a scene's photograph is what its file stores: not rotated, not undistorted, and no frame of a video."""
    return os.path.isfile(scene.photograph or "") and not any(scene.distortion) and not scene.exif_rotation


def _as_detected(scene: Scene) -> np.ndarray:
    """The pixels that ``curio-detect`` saw."""
    assert scene.photograph is not None  # callers look
    file, number = file_of(scene.photograph)
    if not os.path.exists(file):
        if recorded := _RECORDED.fullmatch(str(file)):
            raise DataError(
                f"{file}: a frame of the recording {recorded[1]}, and frames of recordings cannot be drawn over; save "
                "them as image files and run curio-detect on these, or leave out what needs the photographs"
            )
        raise DataError(
            f"{file}: the photograph cannot be read (there is no such file); run where curio-detect ran, or put the "
            "result file beside it"
        )
    if number is not None:
        return _video(file).frame(number)
    return _turned(file) if scene.exif_rotation else read_photograph(file)


def _turned(file: Path) -> np.ndarray:
    try:
        return decode(read_file(file, MAX_FILE_BYTES), apply_exif_rotation=True).pixels
    except OSError as exc:
        raise DataError(f"{file}: the photograph cannot be read ({exc.strerror})") from exc
    except serving.ImageError as exc:
        raise DataError(f"{file}: {exc}") from exc


class _Video:
    """Frames of a video as stored, read one after the other as ``curio-detect`` does: seeking is not always exact."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._frames: Iterator[tuple[np.ndarray | None, float | None]] = iter(())
        self._num_read = 0
        self._pixels: np.ndarray | None = None

    def frame(self, number: int) -> np.ndarray:
        """A frame, uint8 RGB [height, width, 3]. It is reached fast from those shortly before it.

        Raises:
            DataError: The video cannot be read, or has no such frame.
        """
        if number < self._num_read - 1 or self._num_read == 0:
            self._open()
        while self._num_read <= number:
            found = next(self._frames, None)
            if found is None:
                raise self._missing(number)
            self._pixels, _ = found
            self._num_read += 1
        if self._pixels is None:
            raise DataError(f"{self._path}: the video is damaged at frame {number}, which cannot be decoded")
        return self._pixels

    def _open(self) -> None:
        try:
            check_regular(os.stat(self._path), str(self._path))
        except OSError as exc:
            raise DataError(f"{self._path}: the video cannot be read ({exc.strerror})") from exc
        self._frames, self._num_read = decoded_frames(str(self._path)), 0

    def _missing(self, number: int) -> DataError:
        found, self._num_read = self._num_read, 0
        return DataError(
            f"{self._path}: found {found} frames that can be decoded, expected frame {number} (the first is 0); is it "
            "another file by now?"
        )


@functools.lru_cache(maxsize=1)
def _video(path: Path) -> _Video:
    """The scenes of a result file mostly show the frames of one video in their order."""
    return _Video(path)
