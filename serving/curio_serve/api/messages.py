"""Errors and requests as they travel: exceptions to gRPC status, messages to the detector's arguments."""

from functools import lru_cache

import grpc
import numpy as np
from curio_proto.v1.detector_pb2 import PIXEL_FORMAT_BGR8, PIXEL_FORMAT_GRAY8, PIXEL_FORMAT_RGB8, FrameError, RawImage
from curio_proto.v1.detector_pb2 import Camera as CameraMessage
from curio_proto.v1.detector_pb2 import Region as RegionMessage
from google.protobuf.any_pb2 import Any as AnyMessage
from google.protobuf.duration_pb2 import Duration
from google.protobuf.message import Message
from google.rpc import code_pb2, error_details_pb2, status_pb2
from grpc_status import rpc_status

from curio_serve.errors import ArgumentError, CameraError, CurioError, ImageError, Overloaded, status_of
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.image import Frame, RawFormat, from_raw
from curio_serve.imaging.view import Region

DOMAIN = "curio-pose"
MAX_TEXT = 1000  # headers are limited to 8 KiB
_RAW_FORMATS: dict[int, RawFormat] = {PIXEL_FORMAT_RGB8: "RGB8", PIXEL_FORMAT_BGR8: "BGR8", PIXEL_FORMAT_GRAY8: "GRAY8"}


def status_from_error(error: CurioError) -> grpc.Status:
    """GRPC status with the exception's name as reason, and when to come back where the queue is full."""
    retry_s = error.retry_after_s if isinstance(error, Overloaded) else None
    return _status(status_of(error), type(error).__name__, str(error)[:MAX_TEXT], retry_s)


@lru_cache(256)
def _status(name: str, reason: str, message: str, retry_s: float | None) -> grpc.Status:
    """Kept, because in a flood many calls are refused in the same words, and nothing must cost less than that."""
    details: list[Message] = [error_details_pb2.ErrorInfo(reason=reason, domain=DOMAIN)]
    if retry_s is not None:
        delay = Duration()
        delay.FromNanoseconds(int(retry_s * 1e9))
        details.append(error_details_pb2.RetryInfo(retry_delay=delay))
    packed = []
    for detail in details:
        packed.append(AnyMessage())
        packed[-1].Pack(detail)
    return rpc_status.to_status(status_pb2.Status(code=code_pb2.Code.Value(name), message=message, details=packed))


def unreadable(kind: type[Message], num_bytes: int) -> ArgumentError:
    """What a call gets whose message is none of its kind."""
    name = kind.DESCRIPTOR.full_name
    return ArgumentError(
        f"the message of {num_bytes} bytes cannot be read as {name}; was the client made for this API?"
    )


def frame_error(error: CurioError) -> FrameError:
    """The same for one frame of a stream that goes on."""
    code = grpc.StatusCode[status_of(error)].value[0]
    return FrameError(code=code, reason=type(error).__name__, message=str(error)[:MAX_TEXT])


def camera_from_message(message: CameraMessage) -> PinholeCamera:
    """Intrinsics of a request.

    Raises:
        CameraError: Not nine values, or an impossible camera.
    """
    return _camera(message.SerializeToString())


@lru_cache(256)
def _camera(data: bytes) -> PinholeCamera:
    """One camera sends many frames, so its intrinsics are read and checked once."""
    message = CameraMessage.FromString(data)
    values = message.camera_matrix
    if len(values) != 9:
        raise CameraError(f"camera.camera_matrix has {len(values)} values; expected 9: K row after row")
    return PinholeCamera(np.reshape(values, (3, 3)), tuple(message.distortion))


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
