"""Examines a folder of photographs: reads each once and looks for what would spoil training on them."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import ExifTags, Image
from skimage.measure import blur_effect

from curio_train.camera import Intrinsics
from curio_train.data.photographs import Photographs, read_photograph
from curio_train.doctor.finding import Finding, State
from curio_train.doctor.picture_content import examine_content
from curio_train.errors import CurioError

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


_FEWEST, _FEW = 10, 60
_SAME_FOCAL = 0.15  # focal lengths in EXIF are nominal, and rounded to whole millimetres
_FULL_FRAME_WIDTH_MM = 36.0


def examine_photographs(folder: Path, camera: Intrinsics | None) -> tuple[list[Photograph], list[Finding]]:
    """The readable photographs, and what was found about them.

    Args:
        folder: Where they lie.
        camera: What they were taken with, where known.
    """
    try:
        paths = Photographs(folder).paths
    except CurioError as exc:
        return [], [Finding("photographs", "bad", str(exc), fault="photographs unreadable")]
    photographs, broken = [], []
    for path in paths:
        try:
            photographs.append(look_at(path))
        except CurioError as exc:
            broken.append(str(exc))
    findings = [*_unreadable(broken, len(paths))]
    if photographs:
        findings += [_sizes(folder, photographs), *_count(photographs), *_turned(photographs)]
        findings += [*_other_camera(photographs, camera), *examine_content(photographs)]
    return photographs, findings


def named(photographs: Sequence[Photograph]) -> str:
    """How many, and the first of them."""
    more = f" and {len(photographs) - 1} more" if len(photographs) > 1 else ""
    return f"{photographs[0].path.name}{more}"


def _unreadable(broken: list[str], count: int) -> Iterator[Finding]:
    if broken:
        text = f"{len(broken)} of {count} cannot be read, the first: {broken[0]}"
        yield Finding("photographs", "bad", text, "Copy them again or remove them", fault="photographs unreadable")


def _sizes(folder: Path, photographs: Sequence[Photograph]) -> Finding:
    sizes = Counter((photo.width, photo.height) for photo in photographs)
    found = ", ".join(f"{count} of {width}x{height}" for (width, height), count in sizes.most_common(3))
    if len(sizes) == 1:
        return Finding("photographs", "good", f"{folder}: {found}")
    text = f"{folder}: they differ in size: {found}"
    remedy = "One camera file is for one size: keep the photographs of one camera and orientation"
    return Finding("photograph sizes", "bad", text, remedy, fault="mixed sizes")


def _count(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    count = len(photographs)
    if count < _FEW:
        text = f"only {count}; a detector learns from about 200, and below {_FEW} mostly what these show"
        state: State = "bad" if count < _FEWEST else "warning"
        yield Finding(
            "photograph count", state, text, "Take more, from all sides and in the light of later use", fault="too few"
        )


def _turned(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    turned = [photo for photo in photographs if photo.orientation > 1]
    if turned:
        text = f"{len(turned)} have an EXIF rotation ({named(turned)}), which viewers apply and training ignores"
        remedy = "Make sure that K is of the stored pixels, or store them upright and without the EXIF entry"
        yield Finding("photograph rotation", "warning", text, remedy, fault="EXIF rotation")


def _other_camera(photographs: Sequence[Photograph], camera: Intrinsics | None) -> Iterator[Finding]:
    """What photographs say about the camera file given beside them."""
    if camera is None:
        return
    (width, height), _ = Counter((photo.width, photo.height) for photo in photographs).most_common(1)[0]
    expected = f"the camera file is for {camera.width}x{camera.height}, photographs have {width}x{height}"
    if (width, height) == (camera.height, camera.width):
        text, fault = f"{expected}: they are turned by a quarter", "turned"
        yield Finding(
            "photograph sizes", "bad", text, "Store them as the camera was calibrated, or turn K", fault=fault
        )
    elif (width, height) != (camera.width, camera.height):
        same = abs(width / height / (camera.width / camera.height) - 1) < 0.01
        remedy = (
            f"Scale K by {width / camera.width:.4g} (principal point: (c + 0.5) s - 0.5) and set the size"
            if same
            else "They are of another camera, or cut: calibrate with photographs of this size"
        )
        yield Finding("photograph sizes", "bad", expected, remedy, fault="other size")
    yield from _other_focal_length(photographs, camera)


def _other_focal_length(photographs: Sequence[Photograph], camera: Intrinsics) -> Iterator[Finding]:
    noted = [photo.focal_35mm for photo in photographs if photo.focal_35mm]
    if not noted:
        return
    if len(set(noted)) > 1:
        text = f"EXIF notes {len(set(noted))} focal lengths, {min(noted):g} to {max(noted):g} mm: the lens was zoomed"
        yield Finding("photograph focal length", "bad", text, "One camera file is for one zoom: fix it", fault="zoomed")
        return
    longer = max(camera.width, camera.height)
    focal_px = noted[0] / _FULL_FRAME_WIDTH_MM * longer
    if abs(camera.matrix[0, 0] / focal_px - 1) > _SAME_FOCAL:
        text = f"EXIF says {noted[0]:g} mm (35 mm film), about {focal_px:.0f} pixels; K says {camera.matrix[0, 0]:.0f}"
        remedy = "K seems to be of another camera, zoom or size: calibrate this one"
        yield Finding("camera focal length", "warning", text, remedy, "likely", fault="focal length")
