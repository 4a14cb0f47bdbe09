"""Builds a detection request from a path or pixels, and a camera file or a matrix."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from curio_proto.v1 import detector_pb2 as messages

from curio_serve.errors import ArgumentError, ImageError
from curio_serve.files import read_file
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.camera_files import read_camera_file
from curio_serve.imaging.image import MAX_FILE_BYTES
from curio_serve.imaging.image_header import read_header
from curio_serve.imaging.view import Region
from curio_serve.planes.plane import FIND_PLANE, AnyPlane, Plane

ImageLike: TypeAlias = str | Path | bytes | np.ndarray
CameraLike: TypeAlias = str | Path | PinholeCamera | np.ndarray | Sequence[Sequence[float]] | None
RegionLike: TypeAlias = Region | Sequence[float]
_COLORS = {"rgb": messages.PIXEL_FORMAT_RGB8, "bgr": messages.PIXEL_FORMAT_BGR8}
_VERSION = re.compile(r"[1-9][0-9]{0,8}")


def detect_request(
    model: str | Iterable[str],
    image: ImageLike,
    camera: CameraLike = None,
    *,
    objects: Iterable[str] = (),
    regions: Iterable[RegionLike] = (),
    min_confidence: float | None = None,
    max_detections: int | None = None,
    max_instances: int | None = None,
    reads: int | None = None,
    plane: AnyPlane | None = None,
    apply_exif_rotation: bool = False,
    color: Literal["rgb", "bgr"] = "rgb",
    request_id: str = "",
    track: messages.Tracking | None = None,
) -> messages.DetectRequest:
    """The message for one frame.

    Args:
        model: Name, or ``name/version``; several for several objects in one call.
        image: Path of a JPEG, PNG or WebP file, its bytes, or pixels uint8 [height, width, 3] or grey [height, width].
        camera: Camera file, :class:`~curio_serve.imaging.camera.PinholeCamera` or K [3, 3] in pixels; None for models
            that need none.
        objects: Kinds of objects to look for, as the models name them; none: all that they know.
        regions: Rectangles to search, each (x, y, width, height) in pixels; none: the whole frame.
        min_confidence: Detections below it are left out; None: the server's own threshold.
        max_detections: Largest number a region and model, the most confident; None: no limit.
        max_instances: Most of each kind of object and region, 1 to 16, by further runs of a network that reads one
            pose; None: what one run gives.
        reads: How often the image is read, 1 to 9, by as many runs of the network; None: once.
        plane: On which objects stand, in the camera's frame, or "objects": the one on which most of the detected ones
            do. Poses are moved along their lines of sight until they stand there.
        apply_exif_rotation: Turn the pixels as EXIF says, and K with them.
        color: Order of the channels of pixels; OpenCV reads images as ``bgr``.
        request_id: Comes back with the answer; empty: the server makes one up.
        track: Follow objects from frame to frame, in a stream alone.

    Raises:
        ArgumentError: A value is of the wrong shape or kind.
        ImageError: The file cannot be read, or the array is no image.
        CameraError: The camera file cannot be read or belongs to images of another size, or the matrix is no K.
    """
    try:
        request = messages.DetectRequest(
            request_id=request_id,
            models=[selector(name) for name in ([model] if isinstance(model, str) else model)],
            objects=_names(objects),
            regions=[_region(region) for region in regions],
            min_confidence=min_confidence,
            max_detections=max_detections,
            max_instances=max_instances,
            reads=reads,
            plane=_plane(plane),
            apply_exif_rotation=apply_exif_rotation,
            track=track,
        )
    except (TypeError, ValueError) as exc:
        raise ArgumentError(f"a value of the request is of the wrong kind or out of range: {exc}") from exc
    if isinstance(image, np.ndarray):
        request.raw.CopyFrom(_raw(image, color))
        size: tuple[int, int] | None = (request.raw.width, request.raw.height)
    else:
        request.encoded = bytes(image) if isinstance(image, bytes | bytearray | memoryview) else _read(image)
        size = _stored_size(request.encoded)
    if camera is not None:
        request.camera.CopyFrom(_camera(camera, image, size))
    return request


def views_request(
    model: str | Iterable[str],
    views: Iterable[tuple[ImageLike, CameraLike, np.ndarray]],
    *,
    objects: Iterable[str] = (),
    min_confidence: float | None = None,
    max_detections: int | None = None,
    color: Literal["rgb", "bgr"] = "rgb",
    request_id: str = "",
) -> messages.DetectRequest:
    """The message for what several cameras of a rig see at one instant.

    Args:
        model: Name, or ``name/version``; several for several objects in one call.
        views: 2 to 16 of (image, camera, cam_from_rig [4, 4] in metres); images and cameras as in
            :func:`detect_request`.
        objects: Kinds of objects to look for; none: all that the models know.
        min_confidence: None: the server's own threshold.
        max_detections: None: no limit.
        color: Order of the channels of pixels.
        request_id: Comes back with the answer; empty: the server makes one up.

    Raises:
        As :func:`detect_request`.
    """
    request = detect_request(
        model,
        b"",
        objects=objects,
        min_confidence=min_confidence,
        max_detections=max_detections,
        request_id=request_id,
    )
    request.ClearField("encoded")
    for number, of_camera in enumerate(views):
        try:
            image, camera, cam_from_rig = of_camera
            rows = np.asarray(cam_from_rig, float).ravel()
        except (TypeError, ValueError) as exc:
            raise ArgumentError(f"views[{number}]: expected (image, camera, cam_from_rig as [4, 4]); {exc}") from exc
        one = detect_request(model, image, camera, color=color)
        view = request.views.add(cam_from_rig=rows)
        if one.HasField("raw"):
            view.raw.CopyFrom(one.raw)
        else:
            view.encoded = one.encoded
        if one.HasField("camera"):
            view.camera.CopyFrom(one.camera)
    return request


def selector(model: str) -> messages.ModelSelector:
    """``name`` (the latest version) or ``name/version``.

    Raises:
        ArgumentError: It is no text, or the version is not a number from 1 to 999999999.
    """
    if not isinstance(model, str):
        raise ArgumentError(f"model {model!r}: expected a name as text")
    name, slash, version = model.partition("/")
    if slash and not _VERSION.fullmatch(version):
        raise ArgumentError(f"model {model!r}: expected name or name/version with a version from 1 to 999999999")
    try:
        return messages.ModelSelector(name=name, version=int(version or 0))
    except ValueError as exc:  # of a file's name that is no UTF-8
        raise ArgumentError(f"model {model!r}: expected a name in UTF-8") from exc


def _plane(plane: AnyPlane | None) -> messages.Plane | None:
    if isinstance(plane, Plane):
        checked = Plane.of(plane.point_m, plane.normal)  # type: ignore[arg-type]
        return messages.Plane(point_m=checked.point_m, normal=checked.normal)
    if plane not in (None, FIND_PLANE):
        raise ArgumentError(f"plane {plane!r}: expected a Plane, {FIND_PLANE!r} or None")
    return None if plane is None else messages.Plane()


def _names(objects: Iterable[str]) -> list[str]:
    if isinstance(objects, str):
        raise ArgumentError(f"objects is the text {objects!r}; expected a list of names, such as [{objects!r}]")
    return list(objects)


def _raw(pixels: np.ndarray, color: str) -> messages.RawImage:
    if pixels.dtype != np.uint8 or pixels.ndim not in (2, 3) or pixels.shape[2:] not in ((), (3,)):
        raise ImageError(
            f"pixels are {pixels.dtype} {list(pixels.shape)}; expected uint8 [height, width, 3] RGB or "
            "[height, width] grey"
        )
    if color not in _COLORS:
        raise ArgumentError(f"color {color!r}: expected {' or '.join(_COLORS)}")
    kind = _COLORS[color] if pixels.ndim == 3 else messages.PIXEL_FORMAT_GRAY8
    return messages.RawImage(format=kind, width=pixels.shape[1], height=pixels.shape[0], data=pixels.tobytes())


def _read(path: object) -> bytes:
    if not isinstance(path, str | Path):
        raise ImageError(
            f"the image is a {type(path).__name__}; expected pixels [height, width, 3] as a numpy array, the bytes of "
            "an image file, or its path. cv2.imread gives None for a file that it cannot read"
        )
    try:
        return read_file(path, MAX_FILE_BYTES)
    except OSError as exc:
        raise ImageError(f"{path} cannot be read: {exc.strerror}") from exc
    except ValueError as exc:  # a null byte
        raise ImageError(f"{path!r} cannot be read: {exc}") from exc


def _stored_size(encoded: bytes) -> tuple[int, int] | None:
    """Width and height before EXIF's rotation; None for what the server will refuse."""
    try:
        header = read_header(encoded)
    except ImageError:
        return None
    return header.width, header.height


def _camera(
    camera: str | Path | PinholeCamera | np.ndarray | Sequence[Sequence[float]],
    image: ImageLike,
    size: tuple[int, int] | None,
) -> messages.Camera:
    if isinstance(camera, str | Path):
        found = read_camera_file(camera).camera_for(image if isinstance(image, str | Path) else "")
    else:
        found = camera if isinstance(camera, PinholeCamera) else PinholeCamera(_matrix(camera))
    if size is not None and found.size is not None:
        found.check_frame(*size)
    width, height = found.size or (0, 0)
    return messages.Camera(camera_matrix=found.matrix.ravel(), distortion=found.distortion, width=width, height=height)


def _matrix(values: Any) -> np.ndarray:
    try:
        return np.asarray(values, float)
    except (TypeError, ValueError) as exc:
        raise ArgumentError(
            f"camera {values!r}: expected a camera file, a PinholeCamera or K as [3, 3] numbers"
        ) from exc


def _region(region: RegionLike) -> messages.Region:
    values = (region.x, region.y, region.width, region.height) if isinstance(region, Region) else tuple(region)
    if len(values) != 4:
        raise ArgumentError(f"region {values}: expected (x, y, width, height) in pixels")
    x, y, width, height = values
    return messages.Region(x=x, y=y, width=width, height=height)
