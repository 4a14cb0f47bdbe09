"""Builds a detection request from a path or pixels, and a camera file or a matrix."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from curio_proto.v1 import detector_pb2 as messages

from curio_serve.errors import ArgumentError, ImageError
from curio_serve.files import read_file
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.camera_files import read_camera_file
from curio_serve.imaging.image import MAX_FILE_BYTES
from curio_serve.imaging.image_header import read_header
from curio_serve.imaging.view import Region

ImageLike: TypeAlias = str | Path | bytes | np.ndarray
CameraLike: TypeAlias = str | Path | PinholeCamera | np.ndarray | Sequence[Sequence[float]] | None
RegionLike: TypeAlias = Region | Sequence[float]
_VERSION = re.compile(r"[1-9][0-9]{0,8}")


def detect_request(
    model: str | Iterable[str],
    image: ImageLike,
    camera: CameraLike = None,
    *,
    regions: Iterable[RegionLike] = (),
    min_confidence: float | None = None,
    max_detections: int | None = None,
    apply_exif_rotation: bool = False,
    request_id: str = "",
) -> messages.DetectRequest:
    """The message for one frame.

    Args:
        model: Name, or ``name/version``; several for several objects in one call.
        image: Path of a JPEG, PNG or WebP file, its bytes, or pixels uint8 RGB [height, width, 3] or grey
            [height, width].
        camera: Camera file, camera, or K [3, 3] in pixels.
        regions: Each (x, y, width, height) in pixels.
        min_confidence: None: the server's own threshold.
        max_detections: None: no limit.
        apply_exif_rotation: Turn the pixels as EXIF says, and K with them.
        request_id: Comes back with the answer; empty: the server makes one up.

    Raises:
        ArgumentError: A value is of the wrong shape or kind.
        ImageError: The file cannot be read, or the array is no image.
        CameraError: The camera file cannot be read or is of another image size, or the matrix is no K.
    """
    found = None if camera is None else _camera(camera, image)
    request = messages.DetectRequest(
        request_id=request_id,
        models=[selector(name) for name in ([model] if isinstance(model, str) else model)],
        camera=None if found is None else _message(found),
        regions=[_region(region) for region in regions],
        min_confidence=min_confidence,
        max_detections=max_detections,
        apply_exif_rotation=apply_exif_rotation,
    )
    if isinstance(image, np.ndarray):
        request.raw.CopyFrom(_raw(image))
    else:
        request.encoded = image if isinstance(image, bytes) else _read(image)
    if found is not None and found.size is not None:  # the message has no field for it: a server cannot check
        size = request.raw if isinstance(image, np.ndarray) else read_header(request.encoded)
        found.check_frame(size.width, size.height)
    return request


def selector(model: str) -> messages.ModelSelector:
    """``name`` (the latest version) or ``name/version``.

    Raises:
        ArgumentError: The version is not a number from 1 to 999999999.
    """
    name, slash, version = model.partition("/")
    if slash and not _VERSION.fullmatch(version):
        raise ArgumentError(f"model {model!r}: expected name or name/version with a version from 1 to 999999999")
    return messages.ModelSelector(name=name, version=int(version or 0))


def _raw(pixels: np.ndarray) -> messages.RawImage:
    if pixels.dtype != np.uint8 or pixels.ndim not in (2, 3) or pixels.shape[2:] not in ((), (3,)):
        raise ImageError(
            f"pixels are {pixels.dtype} {list(pixels.shape)}; expected uint8 [height, width, 3] RGB or "
            "[height, width] grey"
        )
    kind = messages.PIXEL_FORMAT_RGB8 if pixels.ndim == 3 else messages.PIXEL_FORMAT_GRAY8
    return messages.RawImage(format=kind, width=pixels.shape[1], height=pixels.shape[0], data=pixels.tobytes())


def _read(path: str | Path) -> bytes:
    try:
        return read_file(path, MAX_FILE_BYTES)
    except OSError as exc:
        raise ImageError(f"{path} cannot be read: {exc.strerror}") from exc


def _camera(camera: CameraLike, image: ImageLike) -> PinholeCamera:
    if isinstance(camera, str | Path):
        return read_camera_file(camera).camera_for(image if isinstance(image, str | Path) else "")
    return camera if isinstance(camera, PinholeCamera) else PinholeCamera(_matrix(camera))


def _message(camera: PinholeCamera) -> messages.Camera:
    return messages.Camera(camera_matrix=camera.matrix.ravel(), distortion=camera.distortion)


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
