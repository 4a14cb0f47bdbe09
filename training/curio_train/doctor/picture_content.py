"""Examines what photographs show: blur, repetition, exposure, swapped colours, and the image of the empty scene."""

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import ExifTags, Image
from skimage.measure import blur_effect

from curio_train.camera import Intrinsics
from curio_train.data.photographs import read_photograph
from curio_train.doctor.finding import Finding
from curio_train.errors import CurioError

THUMBNAIL_PX = 64
_MEASURED_PX = 640
_BLACK, _WHITE = 3, 252
# What Pillow raises on them; only of a JPEG's it makes an empty entry itself.
_BROKEN_EXIF = (SyntaxError, struct.error, ArithmeticError, LookupError, OSError, TypeError, ValueError)


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph's measurements, by which whole folders are judged."""

    path: Path
    """Its file."""
    width: int
    """As stored, pixels."""
    height: int
    """As stored, pixels."""
    orientation: int
    """EXIF's; 1 is as stored."""
    focal_35mm: float
    """EXIF's focal length on 35 mm film, or 0."""
    thumbnail: np.ndarray
    """[64, 64, 3] float sRGB, 0 to 255."""
    blur: float
    """0 sharp to 1 blurred (Crété-Roffet et al. 2007), at no more than 640 pixels a side."""
    lost: float
    """Fraction of the pixels that are black or white, and say nothing."""
    brightest: int
    """The largest value of a pixel and channel, 0 to 255."""


def measure(path: Path) -> Photograph:
    """Read a photograph once.

    Raises:
        DataError: It cannot be read.
    """
    pixels = read_photograph(path)
    height, width = pixels.shape[:2]
    orientation, focal = _exif(path)
    blur, lost = sharpness_and_exposure(pixels)
    return Photograph(
        path=path,
        width=width,
        height=height,
        orientation=orientation,
        focal_35mm=focal,
        thumbnail=thumbnail(pixels),
        blur=blur,
        lost=lost,
        brightest=int(pixels.max()),
    )


def sharpness_and_exposure(pixels: np.ndarray) -> tuple[float, float]:
    """What :class:`Photograph` calls ``blur`` and ``lost``, of an image [height, width, 3] uint8."""
    scale = min(1.0, _MEASURED_PX / max(pixels.shape[:2]))
    small = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else pixels
    grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
    # The measure compares an image with itself blurred; of one without any contrast nothing can be said.
    blur = float(blur_effect(grey)) if np.ptp(grey) > 0 else 0.0
    return blur, float(((grey < _BLACK) | (grey > _WHITE)).mean())


def thumbnail(pixels: np.ndarray) -> np.ndarray:
    """An image [height, width, 3] uint8 as [64, 64, 3] float, 0 to 255."""
    return cv2.resize(pixels, (THUMBNAIL_PX, THUMBNAIL_PX), interpolation=cv2.INTER_AREA).astype(np.float64)


def _exif(path: Path) -> tuple[int, float]:
    """Orientation and focal length; of an entry that is missing or broken, what says nothing."""
    try:
        with Image.open(path) as image:
            entries = image.getexif()
            details = entries.get_ifd(ExifTags.IFD.Exif)
        given = entries.get(ExifTags.Base.Orientation, 1), details.get(ExifTags.Base.FocalLengthIn35mmFilm, 0)
        # Broken writers store anything there; what is no number says nothing.
        orientation, focal = (value if isinstance(value, int | float) else 0 for value in given)
        return int(orientation) or 1, float(focal)
    except _BROKEN_EXIF:
        return 1, 0.0


BLURRED = 0.6  # sharp photographs of clutter: up to 0.45; blurred with a sigma of 2.5 pixels: 0.65 and more
_TOLERATED = 0.1  # fraction of photographs
_EQUAL_LEVELS = 4.0  # two frames of one static scene differ by more somewhere, if anything moved
_COMPARED = 60  # neighbours in brightness that each is compared with
MOSTLY_LOST = 0.6
_TWELVE_OF_SIXTEEN_BITS = 16  # of 255: the brightest that 12 bits can be where 16 are read
_BETTER_SWAPPED = 0.6


def examine_content(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Findings that concern the pictures themselves."""
    yield from _blur(photographs)
    yield from _duplicates(photographs)
    yield from _exposure(photographs)
    yield from _swapped(photographs)


def _blur(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    blurred = [photo for photo in photographs if photo.blur > BLURRED]
    if len(blurred) > _TOLERATED * len(photographs):
        worst = max(blurred, key=lambda photo: photo.blur)
        text = f"{len(blurred)} of {len(photographs)} are blurred, most of all {worst.path.name}"
        remedy = "Focus on the object, hold the camera still, use more light; or remove them"
        yield Finding("photograph sharpness", "warning", text, remedy, "likely", fault="blurred")


def _duplicates(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Equal pictures have equal brightness: only neighbours in that order are compared."""
    thumbnails = np.stack([photo.thumbnail for photo in photographs])
    order = np.argsort(thumbnails.mean(axis=(1, 2, 3)), kind="stable")
    pairs = []
    for place, number in enumerate(order):
        others = order[place + 1 : place + 1 + _COMPARED]
        equal = np.abs(thumbnails[others] - thumbnails[number]).max(axis=(1, 2, 3), initial=0) < _EQUAL_LEVELS
        pairs += [(int(number), int(other)) for other in others[equal]]
    repeated = {max(pair) for pair in pairs}
    if repeated:
        first, second = sorted(min(pairs))
        names = f"{photographs[first].path.name} and {photographs[second].path.name}"
        text = f"{len(repeated)} of {len(photographs)} repeat another, for instance {names}"
        yield Finding(
            "photograph copies", "warning", text, "Remove the copies: they teach nothing new", fault="duplicates"
        )


def _exposure(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    dark = [photo for photo in photographs if photo.brightest <= _TWELVE_OF_SIXTEEN_BITS]
    if len(dark) > _TOLERATED * len(photographs):
        text = (
            f"{len(dark)} of {len(photographs)} are nearly black, for instance {dark[0].path.name}, whose brightest "
            f"pixel is read as {dark[0].brightest} of 255"
        )
        remedy = "Where a camera's 10 or 12 bits lie in files of 16, scale them to 16 first (12 bits: times 16)"
        yield Finding("photograph exposure", "warning", text, remedy, "likely", fault="dark")
        return
    lost = [photo for photo in photographs if photo.lost > MOSTLY_LOST]
    if len(lost) > _TOLERATED * len(photographs):
        text = f"{len(lost)} of {len(photographs)} are mostly black or white, for instance {lost[0].path.name}"
        yield Finding("photograph exposure", "warning", text, "Expose for the object", "likely", fault="exposure")


def _swapped(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Raw frames read as BGR here and RGB there: some look like the others only with red and blue exchanged."""
    thumbnails = np.stack([photo.thumbnail for photo in photographs])
    typical = np.median(thumbnails, axis=0)
    swapped = [photo for photo in photographs if has_swapped_channels(photo.thumbnail, typical)]
    if 0 < len(swapped) < len(photographs):
        text = f"{len(swapped)} of {len(photographs)} have red and blue exchanged, for instance {swapped[0].path.name}"
        yield Finding(
            "photograph colours",
            "bad",
            text,
            "Save raw frames as RGB (OpenCV's are BGR)",
            "likely",
            fault="swapped colours",
        )


def has_swapped_channels(picture: np.ndarray, reference: np.ndarray) -> bool:
    """Whether a thumbnail is much closer to the reference with red and blue exchanged."""
    as_is = np.abs(picture - reference).mean()
    exchanged = np.abs(picture[..., ::-1] - reference).mean()
    return bool(exchanged < _BETTER_SWAPPED * as_is)


_SAME_LEVEL = 20.0  # of 255: noise, shadows and reflections of the object stay below
_OTHER_SCENE = 0.25  # fraction of the background image that may differ from most photographs
_UNLIKE_WHEN_SHIFTED_BACK = 0.6
_MOST_COMPARED = 100


def examine_background(path: Path, photographs: Sequence[Photograph], camera: Intrinsics | None) -> Iterator[Finding]:
    """Whether the background image can be read, and fits to photographs, or without them to the camera.

    Args:
        path: The background image's file.
        photographs: What was taken before it.
        camera: What it was taken with, where known; photographs are compared with it elsewhere.
    """
    try:
        pixels = read_photograph(path)
    except CurioError as exc:
        yield Finding("background", "bad", str(exc), fault="background unreadable")
        return
    height, width = pixels.shape[:2]
    others, sizes = "photographs have", {(photo.width, photo.height) for photo in photographs}
    if not sizes and camera is not None:
        others, sizes = "the camera file is for", {(camera.width, camera.height)}
    if sizes and (width, height) not in sizes:
        text = f"{path} has {width}x{height} pixels, {others} {' '.join(f'{w}x{h}' for w, h in sorted(sizes))}"
        yield Finding("background", "bad", text, "Take it with the same camera and settings", fault="background size")
        return
    yield Finding("background", "good", f"{path}: {width}x{height}")
    if photographs:
        yield from _compare(thumbnail(pixels), photographs)


def _compare(background: np.ndarray, photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Objects move from photograph to photograph, so that the median of many shows the scene behind them."""
    seen = np.stack([photo.thumbnail for photo in photographs[:: 1 + len(photographs) // _MOST_COMPARED]])
    scene = np.median(seen, axis=0)
    if _unlike(scene, background) <= _OTHER_SCENE:
        return
    if has_swapped_channels(background, scene):
        text = "the background image fits to the photographs with red and blue exchanged"
        remedy = "One of them was saved as BGR (OpenCV's order): save both as RGB"
        yield Finding("background colours", "bad", text, remedy, "likely", fault="swapped colours")
        return
    gain = np.median(scene + 1, axis=(0, 1)) / np.median(background + 1, axis=(0, 1))
    if _unlike(scene, background * gain) <= _OTHER_SCENE:
        text = f"the photographs are {gain.mean():.2f} times as bright as the background image, which otherwise fits"
        remedy = "Fix exposure and white balance, then take the background image again"
        yield Finding("background exposure", "warning", text, remedy, "likely", fault="background exposure")
        return
    yield _shifted_or_other(scene, background)


def _shifted_or_other(scene: np.ndarray, background: np.ndarray) -> Finding:
    grey = [cv2.cvtColor(picture.astype(np.float32), cv2.COLOR_RGB2GRAY) for picture in (background, scene)]
    window = cv2.createHanningWindow((THUMBNAIL_PX, THUMBNAIL_PX), cv2.CV_32F)
    (right, down), _ = cv2.phaseCorrelate(grey[0], grey[1], window)
    carried = np.roll(background, (round(down), round(right)), axis=(0, 1))
    if _unlike(scene, carried) < _UNLIKE_WHEN_SHIFTED_BACK * _unlike(scene, background):
        across, along = (f"{step / THUMBNAIL_PX:.0%}" for step in (right, down))
        text = f"the background image seems shifted by {across} of the width and {along} of the height"
        remedy = "The camera was moved: take background image and photographs from one tripod position"
        return Finding("background", "bad", text, remedy, "likely", fault="background shifted")
    text = f"{_unlike(scene, background):.0%} of the background image differs from what most photographs show there"
    remedy = "It is of another scene, light or camera position: take it again, or use --backgrounds"
    return Finding("background", "bad", text, remedy, "likely", fault="other background")


def _unlike(scene: np.ndarray, background: np.ndarray) -> float:
    """Fraction of the thumbnail's pixels that differ in a channel."""
    return float((np.abs(scene - background).max(axis=2) > _SAME_LEVEL).mean())
