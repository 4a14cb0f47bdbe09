"""Everything that serving raises on purpose, and what it is called on the wire.

    CurioError
    ├── UsageError              the command cannot be carried out as written: exit status 2
    ├── RequestError            one image or request is wrong; others are not touched
    │   ├── ArgumentError       a field other than the ones below
    │   ├── ImageError          not an image, damaged, of a kind or size that is not accepted
    │   ├── CameraError         intrinsics that are impossible or do not fit the frame
    │   ├── CameraMissing       the model needs intrinsics and the request has none
    │   ├── ModelNotFound       no such model or version
    │   ├── TokenError          bearer token missing or unknown
    │   └── CallEnded           nobody waits any more
    │       ├── DeadlineError   the deadline passed before the work was done
    │       └── CallCancelled   the client hung up
    ├── ModelError              a model folder or file cannot be used
    │   └── CheckNotDone        nobody knows: its check could not be done
    ├── OutputError             results cannot be written
    └── ServiceError            the service, not the request
        ├── Overloaded          the queue is full; try again later
        ├── Unavailable         starting, draining or out of reach
        ├── Unsupported         the service does not offer this call
        └── InternalError       a fault of ours

A text says what was found, what was expected, whose it is (file, field, flag) and what to do.
"""


class CurioError(Exception):
    """Base of all errors of this package."""

    exit_status = 1
    """Exit status of a command that ends with this error."""


class UsageError(CurioError):
    """The command cannot be carried out as written."""

    exit_status = 2


class RequestError(CurioError):
    """One image or request is wrong; others are not touched."""


class ArgumentError(RequestError):
    """A field of a request has a value that is not accepted."""


class ImageError(RequestError):
    """The bytes are no image, are damaged, or have a format or size that is not accepted."""


class CameraError(RequestError):
    """Camera intrinsics are impossible or do not fit the frame."""


class CameraMissing(RequestError):
    """The model needs camera intrinsics and the request has none."""


class ModelNotFound(RequestError):
    """No such model or version."""


class TokenError(RequestError):
    """The bearer token is missing or unknown."""


class CallEnded(RequestError):
    """Nobody waits for the answer any more."""


class DeadlineError(CallEnded):
    """The deadline passed before the work was done."""


class CallCancelled(CallEnded):
    """The client hung up."""


class ModelError(CurioError):
    """A model folder or file cannot be used."""


class CheckNotDone(ModelError):
    """A model could not be checked, which says nothing about it: no process or memory was left, or it took too long."""


class OutputError(CurioError):
    """Results cannot be written where they were asked for."""


class ServiceError(CurioError):
    """The service failed; the request may be fine."""


class Overloaded(ServiceError):
    """The queue is full."""

    retry_after_s: float
    """Seconds after which another attempt makes sense."""

    def __init__(self, text: str, retry_after_s: float = 0.1) -> None:
        super().__init__(text)
        self.retry_after_s = retry_after_s


class Unavailable(ServiceError):
    """The service is starting, draining or out of reach."""


class Unsupported(ServiceError):
    """The service does not offer this call."""


class InternalError(ServiceError):
    """A fault of ours."""


# Error to the name of its gRPC status. The class's name travels as the reason, so the way back is exact between our own
# server and client; the first class of a status is the way back from servers that send none.
STATUS_OF: dict[type[CurioError], str] = {
    ArgumentError: "INVALID_ARGUMENT",
    ImageError: "INVALID_ARGUMENT",
    CameraError: "INVALID_ARGUMENT",
    UsageError: "INVALID_ARGUMENT",
    RequestError: "INVALID_ARGUMENT",
    CameraMissing: "FAILED_PRECONDITION",
    ModelError: "FAILED_PRECONDITION",
    ModelNotFound: "NOT_FOUND",
    TokenError: "UNAUTHENTICATED",
    DeadlineError: "DEADLINE_EXCEEDED",
    CallCancelled: "CANCELLED",
    CallEnded: "CANCELLED",
    Overloaded: "RESOURCE_EXHAUSTED",
    Unavailable: "UNAVAILABLE",
    CheckNotDone: "UNAVAILABLE",
    Unsupported: "UNIMPLEMENTED",
    OutputError: "DATA_LOSS",
    InternalError: "INTERNAL",
    ServiceError: "INTERNAL",
    CurioError: "INTERNAL",
}


def status_of(error: CurioError) -> str:
    """Name of the gRPC status that stands for an error, such as ``"NOT_FOUND"``."""
    return STATUS_OF[type(error)]


def error_from_status(status: str, reason: str, text: str) -> CurioError:
    """The exception behind a failed call.

    Args:
        status: Name of the gRPC status.
        reason: Name of the server's exception; empty if it gave none.
        text: The server's message.
    """
    kinds = {kind.__name__: kind for kind, name in STATUS_OF.items() if name == status}
    if not kinds:
        return InternalError(f"{status}: {text}")
    return kinds.get(reason, next(iter(kinds.values())))(text)
