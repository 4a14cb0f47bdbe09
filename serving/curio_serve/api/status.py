"""Translates errors into gRPC statuses, and counts and logs how each call ends."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, lru_cache

import grpc
from curio_proto.v1.detector_pb2 import FrameError
from google.protobuf.any_pb2 import Any as AnyMessage
from google.protobuf.duration_pb2 import Duration
from google.protobuf.message import Message
from google.rpc import code_pb2, error_details_pb2, status_pb2
from grpc_status import rpc_status

from curio_serve.errors import CallEnded, CurioError, InternalError, Overloaded, status_of
from curio_serve.telemetry import LOGGER, Metrics, log

DOMAIN = "curio-pose"
_MAX_TEXT_BYTES = 1000  # trailers are limited to 8 KiB, and carry the text twice: percent-encoded, and in base64
_MAX_ID_LENGTH = 128


@dataclass
class CallRecord:
    """The fields of a call's log line, besides its method."""

    request_id: str = ""
    """The client's own name for the request, as far as it has been read."""


class CallLog:
    """Counts and logs how calls end."""

    def __init__(self, metrics: Metrics) -> None:
        self._requests = cache(metrics.requests.labels)  # labels() checks and locks each time

    @contextmanager
    def record(self, method: str, caller: grpc.ServicerContext) -> Iterator[CallRecord]:
        """Count and log how the body of a ``with`` statement ends.

        Yields:
            A record, to which the body adds the request's id once it has read it.

        Raises:
            CurioError: What the body raised; a fault of ours as InternalError, whose traceback is in the log.
        """
        call = CallRecord()
        try:
            yield call
        except CurioError as exc:
            self.refused(method, call.request_id, exc, caller)
            raise
        except Exception as exc:
            LOGGER.exception("a request could not be answered")
            error = InternalError("the server failed on this request; its log has the reason")
            self.refused(method, call.request_id, error, caller)
            raise error from exc
        self._requests(method, "OK").inc()
        log(logging.DEBUG, "answered", method=method, request_id=call.request_id[:_MAX_ID_LENGTH])

    def refused(self, method: str, request_id: str, error: CurioError, caller: grpc.ServicerContext) -> None:
        """Count and log a call that ends without an answer."""
        code = status_of(error)
        self._requests(method, code).inc()
        level = logging.INFO
        if isinstance(error, InternalError):
            level = logging.ERROR
        elif isinstance(error, Overloaded | CallEnded):
            level = logging.DEBUG  # they come by the thousand, when time is shortest; the metrics count them
        if LOGGER.isEnabledFor(level):
            values = {"reason": _text(error), "method": method, "request_id": request_id[:_MAX_ID_LENGTH]}
            log(level, "refused", **values, code=code, peer=caller.peer())


def status_from_error(error: CurioError) -> grpc.Status:
    """GRPC status with the exception's name as reason, and the time to come back if the queue is full."""
    retry_s = error.retry_after_s if isinstance(error, Overloaded) else None
    return _status(status_of(error), type(error).__name__, _text(error), retry_s)


def frame_error(error: CurioError) -> FrameError:
    """The status of one frame of a stream, which goes on."""
    code = grpc.StatusCode[status_of(error)].value[0]
    return FrameError(code=code, reason=type(error).__name__, message=_text(error))


@lru_cache(256)
def _status(name: str, reason: str, message: str, retry_s: float | None) -> grpc.Status:
    """Build a status; cached, because a flood of calls is refused with one text and refusals have to be cheap."""
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


def _text(error: CurioError) -> str:
    """An error's text, cut so that it fits into gRPC's trailers."""
    return str(error).encode(errors="replace")[:_MAX_TEXT_BYTES].decode(errors="ignore")
