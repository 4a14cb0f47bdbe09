"""Examines a folder of photographs: reads each once and looks for what would spoil training on them."""

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from curio_train.camera import Intrinsics
from curio_train.data.photographs import FEWEST_TO_LEARN_FROM, Photographs
from curio_train.doctor.finding import Finding
from curio_train.doctor.picture_content import Photograph, examine_content, measure
from curio_train.errors import CurioError

TOO_FEW = "too few"
"""The fault of a folder with few photographs."""

_NOT_SERVED = (".bmp", ".tif", ".tiff")
_SAME_FOCAL = 0.15  # focal lengths in EXIF are nominal, and rounded to whole millimetres
_FULL_FRAME_WIDTH_MM = 36.0
_NAMED = 5  # files that cannot be read, and sizes


def examine_photographs(
    folder: Path, camera: Intrinsics | None, empty: Sequence[Path] = ()
) -> tuple[list[Photograph], list[Finding]]:
    """The readable photographs, and what was found about them.

    Args:
        folder: Where they lie.
        camera: What they were taken with, where known.
        empty: Images of the empty scene, which may lie among them and are no photographs.
    """
    try:
        there = Photographs(folder, empty)
    except CurioError as exc:
        return [], [Finding("photographs", "bad", str(exc), fault="photographs unreadable")]
    with ThreadPoolExecutor(len(os.sched_getaffinity(0)), "measure") as threads:
        measured = list(threads.map(_measured, there.paths))
    photographs = [found for found in measured if isinstance(found, Photograph)]
    broken = [found for found in measured if isinstance(found, str)]
    findings = [*_unreadable(broken, len(there))]
    if photographs:
        findings += [_sizes(folder, photographs, there.note), *_count(photographs, there.note), *_turned(photographs)]
        findings += [*_not_served(photographs), *_other_camera(photographs, camera), *examine_content(photographs)]
    return photographs, findings


def _measured(path: Path) -> Photograph | str:
    """A photograph, or why it cannot be read."""
    try:
        return measure(path)
    except CurioError as exc:
        return str(exc)


def named(photographs: Sequence[Photograph]) -> str:
    """Their number, and the names of the first ones."""
    more = f" and {len(photographs) - 1} more" if len(photographs) > 1 else ""
    return f"{photographs[0].path.name}{more}"


def _unreadable(broken: list[str], count: int) -> Iterator[Finding]:
    if broken:
        more = f"; and {len(broken) - _NAMED} more" if len(broken) > _NAMED else ""
        text = f"{len(broken)} of {count} cannot be read: {'; '.join(broken[:_NAMED])}{more}"
        yield Finding("photographs", "bad", text, "Copy them again or remove them", fault="photographs unreadable")


def _sizes(folder: Path, photographs: Sequence[Photograph], note: str) -> Finding:
    sizes = Counter((photo.width, photo.height) for photo in photographs)
    named = sizes.most_common(_NAMED)
    found = ", ".join(f"{count} of {width}x{height}" for (width, height), count in named)
    if others := len(photographs) - sum(count for _, count in named):
        found += f", {others} of others"
    if len(sizes) == 1:
        return Finding("photographs", "good", f"{folder}: {found}{note}")
    text = f"{folder}: they differ in size: {found}{note}"
    remedy = "One camera file is for one size: keep the photographs of one camera and orientation"
    return Finding("photograph sizes", "bad", text, remedy, fault="mixed sizes")


def _count(photographs: Sequence[Photograph], note: str) -> Iterator[Finding]:
    count = len(photographs)
    if count < FEWEST_TO_LEARN_FROM:
        text = (
            f"only {count}{note}; below {FEWEST_TO_LEARN_FROM} a part's model does not learn from them "
            "(self-training is off), they only judge it"
        )
        remedy = f"Take {FEWEST_TO_LEARN_FROM} or more, from all sides and in the light of later use"
        yield Finding("photograph count", "warning", text, remedy, fault=TOO_FEW)


def _not_served(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Kinds of files that training reads and detection does not."""
    others = [photo for photo in photographs if photo.path.suffix.lower() in _NOT_SERVED]
    if others:
        text = f"{len(others)} are BMP or TIFF ({named(others)}), which training reads and curio-detect does not"
        remedy = "To detect in them, convert them to PNG, JPEG or WebP"
        yield Finding("photograph kind", "warning", text, remedy, fault="not served")


def _turned(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    turned = [photo for photo in photographs if photo.orientation > 1]
    if turned:
        text = f"{len(turned)} have an EXIF rotation ({named(turned)}), which viewers apply and training ignores"
        remedy = "Make sure that K is of the stored pixels, or store them upright and without the EXIF entry"
        yield Finding("photograph rotation", "warning", text, remedy, fault="EXIF rotation")


def _other_camera(photographs: Sequence[Photograph], camera: Intrinsics | None) -> Iterator[Finding]:
    """Finds photographs that contradict the camera file given beside them."""
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
