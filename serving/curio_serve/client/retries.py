"""Turns a failed call into the exception that the server raised, and decides whether to try again."""

import random
import time
from typing import Any

import grpc
from curio_proto.v1.detector_pb2 import DetectResponse
from google.protobuf.message import DecodeError
from google.rpc import error_details_pb2, status_pb2

from curio_serve.errors import ArgumentError, CurioError, ImageError, Overloaded, Unavailable, error_from_status

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.1, 2.0
_LONGEST_S = 1e9  # thirty years
_TOO_LARGE = "larger than max"  # in gRPC's words about a message
_STATUS_DETAILS_KEY = "grpc-status-details-bin"


def deadline_s(timeout_s: float) -> float:
    """A deadline as gRPC can keep it: longer ones, and none (infinity), would have passed at once.

    Raises:
        ArgumentError: It is no number.
    """
    if not isinstance(timeout_s, int | float):
        raise ArgumentError(f"timeout_s {timeout_s!r}: expected seconds")
    return min(timeout_s, _LONGEST_S)


class Attempts:
    """Counts the attempts of one call and keeps its deadline."""

    def __init__(self, address: str, timeout_s: float, max_attempts: int) -> None:
        self._address = address
        self._end = time.monotonic() + deadline_s(timeout_s)
        self._left = max_attempts - 1
        self._pause_s = _FIRST_PAUSE_S

    @property
    def remaining_s(self) -> float:
        """Seconds until the deadline."""
        return max(0.0, self._end - time.monotonic())

    def pause_after(self, failure: grpc.RpcError) -> float:
        """Seconds until the next attempt.

        Raises:
            CurioError: The call is not tried again; this is why it failed.
        """
        error = error_from_call(failure, self._address)
        if isinstance(error, Overloaded):
            pause_s = error.retry_after_s * random.uniform(1.0, 1.5)  # clients of one server must not come back as one
        elif isinstance(error, Unavailable):
            pause_s = self._pause_s * random.uniform(0.5, 1.5)
        else:
            raise error from failure
        if self._left <= 0 or pause_s >= self.remaining_s:
            raise error from failure
        self._left -= 1
        self._pause_s = min(2 * self._pause_s, _LONGEST_PAUSE_S)
        return pause_s


def error_from_call(failure: Any, address: str) -> CurioError:
    """The exception behind a failed call: the one that the server names, else what gRPC's status means."""
    status, text = failure.code().name, failure.details() or ""
    reason, retry_after_s = _details(failure)
    if not reason and status == "UNAVAILABLE":
        return Unavailable(f"no server answers at {address} ({text}); is curio-serve running there?")
    if not reason and status == "DEADLINE_EXCEEDED":
        text = f"{address} did not answer in time; give the call a longer timeout_s ({text})"
    if not reason and status == "RESOURCE_EXHAUSTED" and _TOO_LARGE in text:
        # gRPC's own refusal of a message over its limit carries this status, as that of a call over the limit of calls
        # does; this one never helps to repeat.
        return ImageError(f"the request is larger than {address} accepts ({text}); send a smaller image")
    error = error_from_status(status, reason, text)
    if isinstance(error, Overloaded) and retry_after_s is not None:
        error.retry_after_s = retry_after_s
    return error


def error_from_answer(answer: DetectResponse) -> CurioError | None:
    """The exception that a server answered one frame of a stream with; None if the answer has results."""
    if not answer.HasField("error"):
        return None
    names = {code.value[0]: code.name for code in grpc.StatusCode}
    return error_from_status(names.get(answer.error.code, "UNKNOWN"), answer.error.reason, answer.error.message)


def _details(failure: Any) -> tuple[str, float | None]:
    """(ErrorInfo's reason or "", RetryInfo's delay in seconds or None) of a failed call."""
    reason, retry_after_s = "", None
    packed = dict(failure.trailing_metadata() or ()).get(_STATUS_DETAILS_KEY, b"")
    info, retry = error_details_pb2.ErrorInfo(), error_details_pb2.RetryInfo()
    try:
        details = status_pb2.Status.FromString(packed).details
    except DecodeError:  # another server's idea of details
        return reason, retry_after_s
    for detail in details:
        if detail.Unpack(info):
            reason = info.reason
        elif detail.Unpack(retry):
            retry_after_s = retry.retry_delay.ToMilliseconds() / 1000
    return reason, retry_after_s
