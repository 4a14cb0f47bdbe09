"""A background plate: whether it shows the scene of the photographs, as the same camera sees it."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from curio_train.data.photographs import read_photograph
from curio_train.doctor.finding import Finding
from curio_train.doctor.photograph import THUMBNAIL_PX, Photograph, thumbnail
from curio_train.doctor.picture_content import looks_swapped
from curio_train.errors import CurioError

_SAME_LEVEL = 20.0  # of 255: noise, shadows and reflections of the object stay below
_OTHER_SCENE = 0.25  # share of the plate that may differ from most photographs
_UNLIKE_WHEN_SHIFTED_BACK = 0.6
_MOST_COMPARED = 100


def examine_background(path: Path, photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Whether the plate can be read, and fits to photographs.

    Args:
        path: The plate's file.
        photographs: What was taken before it; nothing is compared where there are none.
    """
    try:
        pixels = read_photograph(path)
    except CurioError as exc:
        yield Finding("background", "bad", str(exc), fault="background unreadable")
        return
    height, width = pixels.shape[:2]
    sizes = {(photo.width, photo.height) for photo in photographs}
    if sizes and (width, height) not in sizes:
        text = f"{path} has {width}x{height} pixels, photographs have {' '.join(f'{w}x{h}' for w, h in sorted(sizes))}"
        yield Finding("background", "bad", text, "Take it with the same camera and settings", fault="background size")
        return
    yield Finding("background", "good", f"{path}: {width}x{height}")
    if photographs:
        yield from _compare(thumbnail(pixels), photographs)


def _compare(plate: np.ndarray, photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Objects move from photograph to photograph, so that the median of many shows the scene behind them."""
    seen = np.stack([photo.thumbnail for photo in photographs[:: 1 + len(photographs) // _MOST_COMPARED]])
    scene = np.median(seen, axis=0)
    if _unlike(scene, plate) <= _OTHER_SCENE:
        return
    if looks_swapped(plate, scene):
        text = "the plate fits to the photographs with red and blue exchanged"
        remedy = "One of them was saved as BGR (OpenCV's order): save both as RGB"
        yield Finding("background colours", "bad", text, remedy, "likely", fault="swapped colours")
        return
    gain = np.median(scene + 1, axis=(0, 1)) / np.median(plate + 1, axis=(0, 1))
    if _unlike(scene, plate * gain) <= _OTHER_SCENE:
        text = f"the photographs are {gain.mean():.2f} times as bright as the plate, which otherwise fits"
        remedy = "Fix exposure and white balance, then take the plate again"
        yield Finding("background exposure", "warning", text, remedy, "likely", fault="background exposure")
        return
    yield _shifted_or_other(scene, plate)


def _shifted_or_other(scene: np.ndarray, plate: np.ndarray) -> Finding:
    grey = [cv2.cvtColor(picture.astype(np.float32), cv2.COLOR_RGB2GRAY) for picture in (plate, scene)]
    window = cv2.createHanningWindow((THUMBNAIL_PX, THUMBNAIL_PX), cv2.CV_32F)
    (right, down), _ = cv2.phaseCorrelate(grey[0], grey[1], window)
    carried = np.roll(plate, (round(down), round(right)), axis=(0, 1))
    if _unlike(scene, carried) < _UNLIKE_WHEN_SHIFTED_BACK * _unlike(scene, plate):
        across, along = (f"{step / THUMBNAIL_PX:.0%}" for step in (right, down))
        text = f"the plate seems shifted by {across} of the width and {along} of the height"
        remedy = "The camera was moved: take plate and photographs from one tripod position"
        return Finding("background", "bad", text, remedy, "likely", fault="background shifted")
    text = f"{_unlike(scene, plate):.0%} of the plate differs from what most photographs show there"
    remedy = "It is of another scene, light or camera position: take it again, or use --backgrounds"
    return Finding("background", "bad", text, remedy, "likely", fault="other background")


def _unlike(scene: np.ndarray, plate: np.ndarray) -> float:
    """Share of the thumbnail's pixels that differ in a channel."""
    return float((np.abs(scene - plate).max(axis=2) > _SAME_LEVEL).mean())
