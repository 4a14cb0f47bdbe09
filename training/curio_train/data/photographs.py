"""Photographs from files: unlabelled training images and backgrounds.

Damaged files are refused here, with their name, instead of entering training as grey or shifted pixels.
"""

import copy
import functools
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from curio_serve.files import by_number, read_file
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.image import MAX_FILE_BYTES
from curio_serve.imaging.view import undistort
from jaxtyping import Bool, Float
from PIL import Image

from curio_train.camera import Intrinsics
from curio_train.errors import DataError


class CameraPoses(NamedTuple):
    """Poses of the camera that took some photographs of one scene."""

    cam_from_world: Float[np.ndarray, "num 4 4"]
    """Rigid, [num, 4, 4]; NaN for photographs whose camera pose is unknown."""
    in_metres: bool = False
    """Whether translations are in metres; else the scene has an arbitrary scale."""

    @property
    def known(self) -> Bool[np.ndarray, " num"]:
        """Whether each photograph's camera pose is known."""
        known: np.ndarray = np.isfinite(self.cam_from_world).all(axis=(1, 2))
        return known


class UnlabelledPhotographs(NamedTuple):
    """Photographs that a world offers for self-training."""

    paths: Sequence[Path]
    """Their files; at most :data:`MAX_UNLABELLED`."""
    cameras: CameraPoses | None = None
    """Where the camera stood for each; None if unknown."""


MAX_UNLABELLED = 300
"""Self-training keeps photographs in memory and refines the pose in each, which takes a sixth of a second."""

NUM_JUDGED = 40
"""Photographs of a part of one's own that its model is judged by, and that it therefore never learns from."""

FEWEST_TO_LEARN_FROM = 2 * NUM_JUDGED
"""With fewer photographs of a part of one's own, self-training is off: all of them judge the model."""

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")

# 50 megapixels: larger than any camera of this trade, small enough to be decoded without harm.
LARGEST_PIXELS = 50_000_000

LONGEST_KEPT_PX = 768

_TIFF, _OPAQUE = (".tif", ".tiff"), 255
_ORIENTATION = 0x0112  # EXIF tag


def read_photograph(path: Path) -> np.ndarray:
    """The pixels of an image file, [height, width, 3] uint8 sRGB, as they are stored.

    EXIF rotation is ignored, because K belongs to the stored pixels. Grey becomes three equal channels, CMYK is
    converted, 16 bits are scaled to 8, and an alpha channel is dropped: what lies beneath it is what is seen.

    Raises:
        DataError: Missing, empty, truncated, no image, or too large to be decoded with a good conscience.
    """
    try:
        content = read_file(path, MAX_FILE_BYTES)
    except OSError as exc:
        raise DataError(f"{path}: the image cannot be read ({exc.strerror})") from exc
    if not content:
        raise DataError(f"{path}: the image file is empty (0 bytes)")
    _check(path)
    flags = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        pixels = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), flags)
    except cv2.error as exc:
        raise DataError(f"{path}: the image cannot be decoded ({exc.err})") from exc
    if pixels is None:
        raise DataError(f"{path}: the image cannot be decoded; expected a PNG, JPEG, WebP, BMP or TIFF file")
    if path.suffix.lower() in _TIFF and pixels.ndim == 3 and pixels.shape[2] == 4 and pixels[..., 3].min() < _OPAQUE:
        raise DataError(
            f"{path}: the TIFF file has transparent pixels, whose colours OpenCV darkens; save it without transparency"
        )
    return _to_rgb8(path, pixels)


def read_frame(path: Path, camera: Intrinsics) -> np.ndarray:
    """A photograph as a camera of the same K without distortion takes it, [height, width, 3] uint8 sRGB.

    Raises:
        DataError: It cannot be read, or is not of the camera's size.
    """
    pixels = read_photograph(path)
    height, width = pixels.shape[:2]
    _check_size(path, (width, height), camera)
    return undistort(pixels, PinholeCamera(camera.matrix, camera.distortion))


def read_frames(paths: Sequence[Path], camera: Intrinsics, width: int, height: int) -> np.ndarray:
    """Photographs as in :func:`read_frame`, resized: [n, 3, height, width] uint8 sRGB.

    Raises:
        DataError: One cannot be read, or is not of the camera's size.
    """
    frames = (read_frame(path, camera) for path in paths)
    resized = [cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA) for frame in frames]
    return np.ascontiguousarray(np.stack(resized).transpose(0, 3, 1, 2))


def check_sizes(paths: Sequence[Path], camera: Intrinsics) -> None:
    """Refuse photographs that are not of a camera's size, by their headers alone.

    Raises:
        DataError: One is no image, or of another size; it is named.
    """
    for path in paths:
        try:
            with Image.open(path) as image:
                size = image.size
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as exc:
            raise DataError(f"{path}: not an image ({exc}); expected a PNG, JPEG, WebP, BMP or TIFF file") from exc
        _check_size(path, size, camera)


def _check_size(path: Path, size: tuple[int, int], camera: Intrinsics) -> None:
    if size != (camera.width, camera.height):
        raise DataError(
            f"{path}: found {size[0]}x{size[1]} pixels, but the camera file is for {camera.width}x{camera.height}; "
            "expected photographs as that camera stores them, neither resized nor turned"
        )


def _check(path: Path) -> None:
    """Refuse large images by their header, then truncated ones.

    Pillow decodes once more for that, because OpenCV fills what is missing with grey and says nothing; Pillow alone
    would not do either, it cuts 16 bits a channel to 8 in some files and clips them in others.
    """
    try:
        with Image.open(path) as image:
            width, height = image.size
            if width * height > LARGEST_PIXELS:
                raise DataError(
                    f"{path}: found {width}x{height} pixels, expected at most {LARGEST_PIXELS:,}; resize it"
                )
            if image.format == "TIFF" and image.getexif().get(_ORIENTATION, 1) != 1:
                raise DataError(
                    f"{path}: found a TIFF file with an EXIF rotation, which decoders apply; save its pixels as they "
                    "are stored, without it, or as PNG"
                )
            image.load()
    except Image.DecompressionBombError as exc:
        raise DataError(f"{path}: found an image too large to decode ({exc}); resize it") from exc
    except (OSError, ValueError, SyntaxError) as exc:
        raise DataError(f"{path}: not a complete image ({exc}); expected a PNG, JPEG, WebP, BMP or TIFF file") from exc


def _to_rgb8(path: Path, pixels: np.ndarray) -> np.ndarray:
    if pixels.dtype == np.uint16:
        pixels = ((pixels.astype(np.uint32) * 255 + 32767) // 65535).astype(np.uint8)
    if pixels.dtype != np.uint8:
        raise DataError(f"{path}: found pixels of type {pixels.dtype}, expected 8 or 16 bits a channel")
    num_channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    conversion = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}.get(num_channels)
    if conversion is None:
        raise DataError(f"{path}: found {num_channels} channels, expected 1, 3 or 4")
    return cv2.cvtColor(pixels, conversion)


def _read_shrunk(path: Path) -> np.ndarray:
    photograph = read_photograph(path)
    scale = LONGEST_KEPT_PX / max(photograph.shape[:2])
    if scale >= 1:
        return photograph
    return cv2.resize(photograph, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def image_files(folder: Path, without: Sequence[Path] = ()) -> tuple[list[Path], list[Path]]:
    """The images in a folder, and those left out, by name, where numbers count by their value.

    Hidden files and sub-folders are passed over.

    Args:
        folder: Where they lie.
        without: Files that are no photographs even where they lie there, such as the image of the empty scene.

    Raises:
        OSError: It cannot be listed.
    """
    # macOS leaves a file ._IMG.jpg beside each IMG.jpg, which is no image.
    visible = (path for path in folder.iterdir() if not path.name.startswith("."))
    found = sorted((path for path in visible if path.suffix.lower() in SUFFIXES), key=lambda path: by_number(path.name))
    others = {os.path.realpath(path) for path in without}
    left_out = [path for path in found if os.path.realpath(path) in others]
    return [path for path in found if path not in left_out], left_out


class Photographs:
    """The images of a folder (not of its subfolders), in the order of their names; hidden files are passed over.

    Args:
        folder: Where they lie.
        without: Images of the empty scene, which are no photographs even where they lie there.

    Raises:
        DataError: There is no such folder, it cannot be listed, or it has no photograph in it.
    """

    def __init__(self, folder: Path, without: Sequence[Path] = ()) -> None:
        try:
            self.paths, left_out = image_files(folder, without)
        except (FileNotFoundError, NotADirectoryError, ValueError) as exc:  # the last: a null byte in its name
            raise DataError(f"{folder}: there is no such folder; expected one with photographs") from exc
        except OSError as exc:
            raise DataError(f"{folder}: cannot be listed ({exc.strerror}); expected a folder of photographs") from exc
        names = " and ".join(path.name for path in left_out)
        self.note = f", not counting {names}, the empty scene" if left_out else ""
        """What was left out, for texts that say how many photographs there are."""
        if not self.paths:
            raise DataError(f"{folder}: found no images{self.note}, expected files ending in {' '.join(SUFFIXES)}")
        # Decoding costs more than rendering the object in front: a few hundred photographs stay in memory, shrunk.
        self._read = functools.lru_cache(maxsize=300)(_read_shrunk)

    def __len__(self) -> int:
        return len(self.paths)

    def subset(self, part: slice) -> "Photographs":
        """Some of them, by place in the order."""
        chosen = copy.copy(self)
        chosen.paths = self.paths[part]
        return chosen

    def random_crop(self, width: int, height: int, rng: np.random.Generator) -> np.ndarray:
        """A part of a random photograph at random scale, mirrored half of the time: a background.

        Args:
            width: Of the crop, pixels.
            height: Of the crop, pixels.
            rng: Draws the photograph, the place, the scale and the mirroring.

        Returns:
            [height, width, 3] uint8 sRGB.

        Raises:
            DataError: The photograph drawn is broken.
        """
        photograph = self._read(self.paths[rng.integers(len(self.paths))])
        # The largest region of the crop's shape that fits, shrunk by up to two: no border is ever invented.
        largest = min(photograph.shape[1] / width, photograph.shape[0] / height)
        scale = largest * rng.uniform(0.5, 1.0)
        columns, rows = (max(1, int(size * scale)) for size in (width, height))
        left = rng.integers(photograph.shape[1] - columns + 1)
        top = rng.integers(photograph.shape[0] - rows + 1)
        region = photograph[top : top + rows, left : left + columns]
        if rng.random() < 0.5:
            region = region[:, ::-1]
        shrinking = columns >= width and rows >= height
        interpolation = cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR
        return cv2.resize(np.ascontiguousarray(region), (width, height), interpolation=interpolation)


def spread(paths: Sequence[Path], count: int) -> list[Path]:
    """At most ``count`` of the paths, evenly spaced over all of them."""
    return [paths[number] for number in np.unique(np.linspace(0, len(paths) - 1, count).astype(int))] if paths else []
