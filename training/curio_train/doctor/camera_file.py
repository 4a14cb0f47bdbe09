"""A camera file: whether it describes a camera, and mistakes that still look like one."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from curio_train.camera import Intrinsics, load_intrinsics
from curio_train.doctor.finding import Finding
from curio_train.errors import CurioError

_USUAL_VIEW_DEG = (8.0, 110.0)  # of the longer side: from a long lens to a wide one
_SQUARE = 0.03  # fx and fy of real sensors differ by less
_CENTRED = 0.12  # principal points lie closer to the middle, in image sizes


def examine_camera(path: Path) -> tuple[Intrinsics | None, list[Finding]]:
    """The camera, where the file describes one, and what is odd about it."""
    try:
        found = load_intrinsics(path)
    except CurioError as exc:
        return None, [Finding("camera", "bad", str(exc), fault=_kind(str(exc)))]
    across, down = _view_deg(found)
    bent = "with distortion" if any(found.distortion) else "without distortion"
    text = f"{path}: {found.width}x{found.height} pixels, sees {across:.0f} by {down:.0f} degrees, {bent}"
    return found, [Finding("camera", "good", text), *_centre(found), *_focal_length(found)]


def _kind(message: str) -> str:
    """Which fault a refusal is about."""
    kinds = {"transposed": "transposed matrix", "principal point": "other resolution", "focal length": "focal length"}
    return next((fault for word, fault in kinds.items() if word in message), "camera unreadable")


def _view_deg(camera: Intrinsics) -> np.ndarray:
    sizes = np.array([camera.width, camera.height])
    return np.degrees(2 * np.arctan(sizes / 2 / np.diag(camera.matrix)[:2]))


def _centre(camera: Intrinsics) -> Iterator[Finding]:
    size = np.array([camera.width, camera.height])
    centre = camera.matrix[:2, 2] + 0.5
    if np.abs(centre / size - 0.5).max() < _CENTRED:
        return
    at = f"the principal point ({centre[0] - 0.5:.5g}, {centre[1] - 0.5:.5g}) lies far from the middle"
    if np.abs(centre[::-1] / size - 0.5).max() < _CENTRED:
        remedy = "Swap cx and cy, or width and height if the image is upright"
        text = f"{at} of {camera.width}x{camera.height}; cx and cy seem to be swapped"
        yield Finding("camera centre", "warning", text, remedy, "likely", fault="swapped centre")
        return
    ratios = centre / size * 2
    if abs(ratios[0] / ratios[1] - 1) < _CENTRED:
        other = np.round(centre * 2).astype(int)
        text = f"{at} of {camera.width}x{camera.height}; K seems to be of an image of about {other[0]}x{other[1]}"
        remedy = f"Multiply its first two rows by {1 / ratios.mean():.3g}, or give width and height of that image"
        yield Finding("camera resolution", "warning", text, remedy, "likely", fault="other resolution")
        return
    text = f"{at} of {camera.width}x{camera.height}"
    yield Finding(
        "camera centre",
        "warning",
        text,
        "Right for a cut-out image alone; else calibrate",
        "possible",
        fault="odd centre",
    )


def _focal_length(camera: Intrinsics) -> Iterator[Finding]:
    fx, fy = np.diag(camera.matrix)[:2]
    if abs(fx / fy - 1) > _SQUARE:
        text = f"fx {fx:.5g} and fy {fy:.5g} differ by {abs(fx / fy - 1):.0%}, pixels of cameras are square"
        remedy = "Was the image squeezed, or K scaled with one factor for both sides? Calibrate at the stored size"
        yield Finding("camera focal length", "warning", text, remedy, "likely", fault="focal length")
    low, high = _USUAL_VIEW_DEG
    widest = float(_view_deg(camera).max())
    if not low <= widest <= high:
        text = f"a view of {widest:.3g} degrees is unusual; the focal length of {fx:.5g} may not be in pixels"
        remedy = "Focal length in pixels = focal length in mm / sensor width in mm x image width"
        yield Finding("camera focal length", "warning", text, remedy, "likely", fault="focal length")
