"""What is kept of a photograph after one look at it: enough to compare hundreds."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import ExifTags, Image
from skimage.measure import blur_effect

from curio_train.data.photographs import read_photograph

THUMBNAIL_PX = 64
_LOOKED_AT_PX = 640
_BLACK, _WHITE = 3, 252


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph's vital signs.

    Attributes:
        path: Its file.
        width: As stored, pixels.
        height: As stored, pixels.
        orientation: EXIF's; 1 is as stored.
        focal_35mm: EXIF's focal length on 35 mm film, or 0.
        thumbnail: [64, 64, 3] float sRGB, 0 to 255.
        blur: 0 sharp to 1 blurred (Crété-Roffet et al. 2007), at no more than 640 pixels a side.
        lost: Share of the pixels that are black or white, and say nothing.
    """

    path: Path
    width: int
    height: int
    orientation: int
    focal_35mm: float
    thumbnail: np.ndarray
    blur: float
    lost: float


def look_at(path: Path) -> Photograph:
    """Read a photograph once.

    Raises:
        DataError: It cannot be read.
    """
    pixels = read_photograph(path)
    height, width = pixels.shape[:2]
    scale = min(1.0, _LOOKED_AT_PX / max(width, height))
    small = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else pixels
    grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
    orientation, focal = _exif(path)
    return Photograph(
        path=path,
        width=width,
        height=height,
        orientation=orientation,
        focal_35mm=focal,
        thumbnail=thumbnail(pixels),
        # The measure compares an image with itself blurred; of one without any contrast nothing can be said.
        blur=float(blur_effect(grey)) if np.ptp(grey) > 0 else 0.0,
        lost=float(((grey < _BLACK) | (grey > _WHITE)).mean()),
    )


def thumbnail(pixels: np.ndarray) -> np.ndarray:
    """An image [height, width, 3] uint8 as [64, 64, 3] float, 0 to 255."""
    return cv2.resize(pixels, (THUMBNAIL_PX, THUMBNAIL_PX), interpolation=cv2.INTER_AREA).astype(np.float64)


def _exif(path: Path) -> tuple[int, float]:
    with Image.open(path) as image:
        entries = image.getexif()
        details = entries.get_ifd(ExifTags.IFD.Exif)
    orientation, focal = entries.get(ExifTags.Base.Orientation, 1), details.get(ExifTags.Base.FocalLengthIn35mmFilm, 0)
    # Broken writers store anything there; what is no number says nothing.
    numbers = [value if isinstance(value, int | float) else 0 for value in (orientation, focal)]
    return int(numbers[0]) or 1, float(numbers[1])
