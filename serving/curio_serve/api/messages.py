"""Translates protobuf messages into the detector's arguments."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from curio_proto.v1.detector_pb2 import PIXEL_FORMAT_BGR8, PIXEL_FORMAT_GRAY8, PIXEL_FORMAT_RGB8, RawImage
from curio_proto.v1.detector_pb2 import Camera as CameraMessage
from curio_proto.v1.detector_pb2 import Plane as PlaneMessage
from curio_proto.v1.detector_pb2 import Region as RegionMessage

from curio_serve.errors import CameraError, ImageError
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.image import Frame, RawFormat, from_raw
from curio_serve.imaging.view import Region
from curio_serve.planes.plane import FIND_PLANE, AnyPlane, Plane

_RAW_FORMATS: dict[int, RawFormat] = {PIXEL_FORMAT_RGB8: "RGB8", PIXEL_FORMAT_BGR8: "BGR8", PIXEL_FORMAT_GRAY8: "GRAY8"}


def camera_from_message(message: CameraMessage) -> PinholeCamera:
    """Intrinsics of a request.

    Raises:
        CameraError: Not nine values, one side of the frame's size without the other, or an impossible camera.
    """
    if len(message.camera_matrix) != 9:
        raise CameraError(f"camera.camera_matrix has {len(message.camera_matrix)} values; expected 9: K row after row")
    size = message.width, message.height
    if any(size) and not all(size):
        raise CameraError(f"camera.width and camera.height are {size[0]} and {size[1]}; expected both, or neither")
    return _camera(tuple(message.camera_matrix), tuple(message.distortion), size if all(size) else None)


@lru_cache(256)
def _camera(matrix: Sequence[float], distortion: tuple[float, ...], size: tuple[int, int] | None) -> PinholeCamera:
    """One camera sends many frames, so its intrinsics are checked once."""
    return PinholeCamera(np.reshape(matrix, (3, 3)), distortion, size)


def plane_from_message(message: PlaneMessage) -> AnyPlane:
    """The plane of a request, or that it is to be found.

    Raises:
        ArgumentError: It is impossible, or has a point or a normal alone.
    """
    if not message.point_m and not message.normal:
        return FIND_PLANE
    return Plane.of(message.point_m, message.normal)


def region_from_message(message: RegionMessage) -> Region:
    """A region of interest of a request."""
    return Region(message.x, message.y, message.width, message.height)


def frame_from_raw(message: RawImage, max_pixels: int) -> Frame:
    """Pixels of a request that came without an encoding.

    Raises:
        ImageError: No known format, or size and data do not fit together.
    """
    if message.format not in _RAW_FORMATS:
        raise ImageError(f"raw.format is {message.format}; expected RGB8 (1), BGR8 (2) or GRAY8 (3)")
    raw_format = _RAW_FORMATS[message.format]
    return from_raw(message.data, raw_format, message.width, message.height, message.stride, max_pixels=max_pixels)
