"""Camera files: our JSON, BOP's camera.json and scene_camera.json, OpenCV's YAML.

ours              {"camera_matrix": [[fx,0,cx],[0,fy,cy],[0,0,1]], "width": w, "height": h, "distortion": [...]}
camera.json       {"fx":, "fy":, "cx":, "cy":, "width":, "height":, ...}
scene_camera.json {"0": {"cam_K": [9 values], ...}, "1": ...}: K of each image, by the number in its file's name
OpenCV YAML       camera_matrix, distortion_coefficients, image_width, image_height (as written by its calibration)
"""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from curio_serve.errors import CameraError
from curio_serve.imaging.camera import PinholeCamera


@dataclass(frozen=True)
class CameraFile:
    """What a camera file holds: one camera for all images, or one for each image number."""

    path: Path
    camera: PinholeCamera | None
    per_image: Mapping[int, PinholeCamera]

    def camera_for(self, image: str | Path) -> PinholeCamera:
        """The camera of an image; in a file with one for each, by the last number in the image's file name.

        Raises:
            CameraError: The file has none for it.
        """
        if self.camera is not None:
            return self.camera
        numbers = re.findall(r"\d+", Path(image).stem)
        if not numbers:
            raise CameraError(f"{self.path} has K for each image number, but the name of {image} has no number")
        number = int(numbers[-1])
        if number not in self.per_image:
            known = sorted(self.per_image)
            raise CameraError(
                f"{self.path} has no K for image {number} ({image}); it has {len(known)} from {known[0]} to {known[-1]}"
            )
        return self.per_image[number]


def read_camera_file(path: str | Path) -> CameraFile:
    """Read any of the formats above.

    Raises:
        CameraError: Missing, unreadable, of no known format, or with an impossible camera.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as exc:
        raise CameraError(f"camera file {path} cannot be read: {exc}") from exc
    try:
        if path.suffix.lower() in (".yml", ".yaml"):
            return CameraFile(path, _from_opencv(text), {})
        return _from_json(path, json.loads(text))
    except json.JSONDecodeError as exc:
        raise CameraError(f"camera file {path} is not JSON: {exc}; OpenCV files need the suffix .yml or .yaml") from exc
    except CameraError as exc:
        raise CameraError(f"camera file {path}: {exc}") from exc
    except (TypeError, ValueError, KeyError, SystemError, cv2.error) as exc:
        # OpenCV's reader turns its own errors into SystemError.
        raise CameraError(f"camera file {path} cannot be understood: {exc!r}") from exc


def _from_json(path: Path, content: Any) -> CameraFile:
    if isinstance(content, dict) and "camera_matrix" in content:
        size = _size(content.get("width"), content.get("height"))
        distortion = _distortion(content.get("distortion"))
        return CameraFile(path, PinholeCamera(_matrix(content["camera_matrix"]), distortion, size), {})
    if isinstance(content, dict) and {"fx", "fy", "cx", "cy"} <= content.keys():
        fx, fy, cx, cy = (float(content[name]) for name in ("fx", "fy", "cx", "cy"))
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        return CameraFile(path, PinholeCamera(matrix, (), _size(content.get("width"), content.get("height"))), {})
    if isinstance(content, dict) and content and all(isinstance(v, dict) and "cam_K" in v for v in content.values()):
        return CameraFile(path, None, {int(n): PinholeCamera(_matrix(v["cam_K"])) for n, v in content.items()})
    found = sorted(content)[:8] if isinstance(content, dict) else type(content).__name__
    raise CameraError(
        f"unknown format with {found}; expected camera_matrix (3x3 rows) with width and height, "
        "BOP's fx, fy, cx, cy, or BOP's scene_camera.json with cam_K for each image"
    )


def _matrix(values: Any) -> np.ndarray:
    array = np.asarray(values, float)
    return array.reshape(3, 3) if array.shape == (9,) else array


def _distortion(values: Any) -> tuple[float, ...]:
    if values is not None and not isinstance(values, list):
        raise CameraError(f"distortion is {values!r}; expected a list of numbers [k1, k2, p1, p2, k3]")
    return tuple(float(v) for v in values or ())


def _size(width: Any, height: Any) -> tuple[int, int] | None:
    if width is None or height is None:
        return None
    for name, value in (("width", width), ("height", height)):
        if isinstance(value, bool) or not isinstance(value, int | float) or value != int(value) or value < 1:
            raise CameraError(f"{name} is {value!r}; expected a whole number of pixels")
    return int(width), int(height)


def _from_opencv(text: str) -> PinholeCamera:
    storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    try:
        matrix = storage.getNode("camera_matrix").mat()
        if matrix is None:
            raise CameraError("no matrix camera_matrix; expected a file of OpenCV's calibration")
        distortion = storage.getNode("distortion_coefficients").mat()
        width, height = storage.getNode("image_width"), storage.getNode("image_height")
        size = None if width.empty() or height.empty() else (int(width.real()), int(height.real()))
    finally:
        storage.release()
    return PinholeCamera(matrix, () if distortion is None else tuple(map(float, distortion.ravel())), size)
