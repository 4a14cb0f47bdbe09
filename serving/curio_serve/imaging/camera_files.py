"""Reads camera files: our JSON, BOP's camera.json and scene_camera.json, OpenCV's YAML, ROS's camera_info.

ours              {"camera_matrix": [[fx,0,cx],[0,fy,cy],[0,0,1]], "width": w, "height": h, "distortion": [...]}
camera.json       {"fx":, "fy":, "cx":, "cy":, "width":, "height":, "distortion": [...], ...}; BOP has none
scene_camera.json {"0": {"cam_K": [9 values], ...}, "1": ...}: K of each image, by the number in its file's name
OpenCV YAML       camera_matrix, distortion_coefficients, image_width, image_height (as written by its calibration)
ROS YAML          the same names (as written by camera_calibration), or a CameraInfo message: k, d, width, height
ROS JSON          a CameraInfo message: k, d, width, height (ROS 1: K, D)
"""

import json
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from curio_serve.errors import CameraError
from curio_serve.files import read_file
from curio_serve.imaging.camera import PinholeCamera

MAX_BYTES = 64 << 20
_DISTORTION = ("distortion", "distortion_coefficients", "dist_coeffs", "dist")
_OF_SCENE = "scene_camera.json"  # BOP's, in the folder of a scene, whose images lie in folders beside it
_LENS = re.compile(r"d|.*dist(ort|_?coef|$).*", re.IGNORECASE)  # whatever else says something of the lens
_COEFFICIENT = re.compile(r"[kp]\d")  # each by itself, as some calibrations write them
_ROS_MODELS = ("", "plumb_bob", "rational_polynomial")  # OpenCV's own lenses


@dataclass(frozen=True)
class CameraFile:
    """The content of a camera file: one camera for all images, or one for each image number."""

    path: Path
    """The file."""
    camera: PinholeCamera | None
    """The camera of all images; None if each image has its own."""
    per_image: Mapping[int, PinholeCamera]
    """Cameras by image number; empty if one camera took all images."""

    def camera_for(self, image: str | Path) -> PinholeCamera:
        """The camera of an image; in a file with one for each, by the last number in the image's file name.

        Raises:
            CameraError: The file has no camera for it.
        """
        if self.camera is not None:
            return self.camera
        numbers = re.findall(r"\d+", Path(image).stem)
        if not numbers:
            raise CameraError(f"{self.path} has K for each image number, but the name of {image} has no number")
        other = Path(image).parent.parent / _OF_SCENE
        if self.path.name == _OF_SCENE and os.path.exists(other) and not os.path.samefile(other, self.path):
            raise CameraError(f"{image} is of another scene than {self.path}: its cameras are in {other}")
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
        text = read_file(path, MAX_BYTES).decode("utf-8-sig")
    except OSError as exc:
        raise CameraError(f"camera file {path} cannot be read: {exc.strerror}") from exc
    except ValueError as exc:
        raise CameraError(f"camera file {path} is no text; expected JSON or YAML") from exc
    try:
        if path.suffix.lower() in (".yml", ".yaml"):
            return CameraFile(path, _from_yaml(text), {})
        return _from_json(path, json.loads(text))
    except json.JSONDecodeError as exc:
        raise CameraError(f"camera file {path} is not JSON: {exc}; OpenCV files need the suffix .yml or .yaml") from exc
    except CameraError as exc:
        raise CameraError(f"camera file {path}: {exc}") from exc
    except (TypeError, ValueError, KeyError, OverflowError, RecursionError, SystemError, cv2.error) as exc:
        # OpenCV's reader turns its own errors into SystemError.
        raise CameraError(f"camera file {path} cannot be understood: {exc!r}") from exc


def _from_json(path: Path, content: Any) -> CameraFile:
    if isinstance(content, dict) and "camera_matrix" in content:
        return CameraFile(path, camera_of_entry(content), {})
    if isinstance(content, dict) and (names := content.keys() & {"k", "K"}):
        return CameraFile(path, camera_of_info(content, names.pop()), {})
    if isinstance(content, dict) and {"fx", "fy", "cx", "cy"} <= content.keys():
        fx, fy, cx, cy = (float(content[name]) for name in ("fx", "fy", "cx", "cy"))
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        size, distortion = _size(content.get("width"), content.get("height")), _known_lens(content)
        return CameraFile(path, PinholeCamera(matrix, distortion, size), {})
    if isinstance(content, dict) and content and all(isinstance(v, dict) and "cam_K" in v for v in content.values()):
        return CameraFile(path, None, {int(n): PinholeCamera(_matrix(v["cam_K"])) for n, v in content.items()})
    found = sorted(content)[:8] if isinstance(content, dict) else type(content).__name__
    raise CameraError(
        f"unknown format with {found}; expected camera_matrix (3x3 rows) with width and height, "
        "BOP's fx, fy, cx, cy, or BOP's scene_camera.json with cam_K for each image"
    )


def camera_of_entry(content: Mapping[str, Any]) -> PinholeCamera:
    """The camera of our JSON: ``camera_matrix``, and where given ``width``, ``height`` and ``distortion``.

    Raises:
        CameraError: It is impossible, or has something about its lens that is not read.
        TypeError: A value is of another kind; ValueError and OverflowError: a number cannot be read.
    """
    width, height = (content.get(name, content.get(f"image_{name}")) for name in ("width", "height"))
    return PinholeCamera(_matrix(content["camera_matrix"]), _known_lens(content), _size(width, height))


def _matrix(values: Any) -> np.ndarray:
    array = np.asarray(values, float)
    return array.reshape(3, 3) if array.shape == (9,) else array


def _known_lens(content: Mapping[str, Any]) -> tuple[float, ...]:
    """The coefficients in a JSON file, by whichever name it has for them; what is not read is refused."""
    given = [name for name in _DISTORTION if content.get(name) is not None]
    if len(given) > 1:
        raise CameraError(f"found {' and '.join(given)}; expected the distortion once")
    distortion = _distortion(content[given[0]]) if given else ()
    _refuse_unread_lens(name for name, value in content.items() if isinstance(value, list | dict) and value)
    unread = [name for name in content if _COEFFICIENT.fullmatch(name) and content[name]]
    if unread and not given:
        raise CameraError(f"found {', '.join(sorted(unread))}; expected distortion as a list [k1, k2, p1, p2, k3]")
    _refuse_other_lens(content.get("distortion_model", ""), distortion)
    return distortion


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


def camera_of_info(content: Mapping[str, Any], name: str) -> PinholeCamera:
    """The camera of a ROS CameraInfo message, whose matrix is called ``k`` or ``K``.

    Raises:
        CameraError: It has the lenses of another model than plumb_bob or rational_polynomial.
    """
    distortion = content.get("d") or content.get("D") or []
    _refuse_other_lens(content.get("distortion_model", ""), distortion)
    size = _size(content.get("width"), content.get("height"))
    return PinholeCamera(_matrix(content[name]), _distortion(distortion), size)


def camera_of_images(info: Any, topic: str) -> PinholeCamera:
    """The camera of the images of a ROS 2 topic.

    K and D of a CameraInfo message are of raw images. Rectified ones, whose topics are called ``image_rect…``, have the
    left three columns of P as their K, and no distortion.

    Args:
        info: The ``sensor_msgs/msg/CameraInfo`` of an image.
        topic: Name of the images' topic; that of compressed images ends in ``/compressed``.

    Raises:
        CameraError: It has the lenses of another model than plumb_bob or rational_polynomial, or is not calibrated.
    """
    content: dict[str, Any] = {"width": info.width, "height": info.height}
    if topic.removesuffix("/compressed").rpartition("/")[2].startswith("image_rect"):
        content["k"] = [info.p[i] for i in (0, 1, 2, 4, 5, 6, 8, 9, 10)]
    else:
        content |= {"k": list(info.k), "d": list(info.d), "distortion_model": info.distortion_model}
    return camera_of_info(content, "k")


def _refuse_unread_lens(names: Iterable[str]) -> None:
    """Refuse coefficients under a name that is not read; the names are those of lists and matrices."""
    if unread := sorted(name for name in names if _LENS.fullmatch(name) and name not in _DISTORTION):
        raise CameraError(f"found {unread[0]}, which is not read; expected the lens as {' or '.join(_DISTORTION)}")


def _refuse_other_lens(model: object, distortion: Iterable[float]) -> None:
    if model not in _ROS_MODELS and any(distortion):
        raise CameraError(f"distortion_model is {model!r}; expected one of {', '.join(filter(None, _ROS_MODELS))}")


def _from_yaml(text: str) -> PinholeCamera:
    if not text.startswith("%YAML"):  # OpenCV's reader wants its head, one document, and lists that are indented
        document = text.removeprefix("---").split("\n---")[0]
        text = "%YAML:1.0\n---\n" + re.sub("^- ", "  - ", document, flags=re.MULTILINE)
    storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    try:
        for name in ("k", "K"):
            if not storage.getNode(name).empty():
                wanted = (name, "d", "D", "distortion_model", "width", "height")
                return camera_of_info({key: _plain(storage.getNode(key)) for key in wanted}, name)
        matrix = _yaml_matrix(storage.getNode("camera_matrix"))
        if matrix is None:
            raise CameraError("no matrix camera_matrix; expected a file of OpenCV's or ROS's calibration")
        names = storage.root().keys()
        _refuse_unread_lens(name for name in names if _is_nested(storage.getNode(name)))
        if not (fisheye := storage.getNode("fisheye_model")).empty() and fisheye.real():
            raise CameraError("fisheye_model is set; expected OpenCV's model of ordinary lenses")
        nodes = [node for name in _DISTORTION if not (node := storage.getNode(name)).empty()]
        distortion = _yaml_matrix(nodes[0]) if nodes else None
        model = storage.getNode("distortion_model")
        _refuse_other_lens("" if model.empty() else model.string(), () if distortion is None else distortion.ravel())
        width, height = storage.getNode("image_width"), storage.getNode("image_height")
        size = None if width.empty() or height.empty() else _size(width.real(), height.real())
    finally:
        storage.release()
    return PinholeCamera(_matrix(matrix), () if distortion is None else tuple(map(float, distortion.ravel())), size)


def _yaml_matrix(node: cv2.FileNode) -> np.ndarray | None:
    """A matrix as OpenCV marks it, or as ROS writes it: a map with a list ``data``."""
    if node.isMap() and not (data := node.getNode("data")).empty() and node.getNode("dt").empty():
        return np.array(_plain(data), float)
    matrix: np.ndarray | None = node.mat()
    return matrix


def _is_nested(node: cv2.FileNode) -> bool:
    return bool(node.isMap() or node.isSeq())


def _plain(node: cv2.FileNode) -> Any:
    """A node as list, number, text or None."""
    if node.empty():
        return None
    if node.isSeq():
        return [node.at(i).real() for i in range(node.size())]
    return node.string() if node.isString() else node.real()
