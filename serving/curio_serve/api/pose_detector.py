"""The typed API ``curio.v1.PoseDetector``: translates between messages and the detector, and nothing else."""

import itertools
import logging
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from typing import TypeVar

import grpc
from curio_proto.v1 import detector_pb2 as messages
from curio_proto.v1.detector_pb2_grpc import PoseDetectorServicer

from curio_serve.api import messages as wire
from curio_serve.api.admission import WorkQueue
from curio_serve.errors import ArgumentError, CallEnded, CurioError, ImageError, InternalError, Overloaded, status_of
from curio_serve.imaging import image
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.models.detector import Detector
from curio_serve.models.repository import Repository
from curio_serve.telemetry import LOGGER, Metrics, log

Context = grpc.ServicerContext
Answer = TypeVar("Answer")
_MAX_ID_LENGTH = 128
_ID_PREFIX, _ID_NUMBERS = secrets.token_hex(8), itertools.count()


@dataclass(frozen=True)
class Limits:
    """What a request may ask for. Names are those of the server's settings."""

    max_pixels: int = image.MAX_PIXELS
    max_regions: int = 64
    max_models: int = 16
    max_streams: int = 256
    min_confidence: float = 0.0
    full_decode: bool = False


class CallGuard:
    """Runs a call's body, turns its exceptions into statuses, counts and logs it."""

    def __init__(self, metrics: Metrics) -> None:
        self._requests = cache(metrics.requests.labels)  # labels() checks and locks each time

    def run(self, method: str, request_id: str, context: Context, body: Callable[[], Answer]) -> Answer:
        """Call the body; abort the call with the status of what it raises."""
        answer = self.attempt(method, request_id, context, body)
        if isinstance(answer, CurioError):
            context.abort_with_status(wire.status_from_error(answer))
        return answer

    def attempt(
        self, method: str, request_id: str, context: Context, body: Callable[[], Answer]
    ) -> Answer | CurioError:
        """Call the body; what it raises is counted, logged and returned."""
        try:
            answer = body()
        except CurioError as exc:
            self._refused(method, request_id, exc, context)
            return exc
        except Exception:  # noqa: BLE001 - a fault of ours, which its caller shall hear of
            LOGGER.exception("a request could not be answered")
            error = InternalError("the server failed on this request; its log says where")
            self._refused(method, request_id, error, context)
            return error
        self._requests(method, "OK").inc()
        log(logging.DEBUG, "answered", method=method, request_id=request_id)
        return answer

    def _refused(self, method: str, request_id: str, error: CurioError, context: Context) -> None:
        """Count and log a call that ends without an answer."""
        code = status_of(error)
        self._requests(method, code).inc()
        level = logging.INFO
        if isinstance(error, InternalError):
            level = logging.ERROR
        elif isinstance(error, Overloaded | CallEnded):
            level = logging.DEBUG  # they come by the thousand, when time is shortest; the metrics count them
        if LOGGER.isEnabledFor(level):
            reason = str(error)[: wire.MAX_TEXT]
            log(level, "refused", reason=reason, method=method, request_id=request_id, code=code, peer=context.peer())


class PoseService(PoseDetectorServicer):
    """Answers ``PoseDetector``'s calls, each on a thread of its own."""

    def __init__(self, repository: Repository, work: WorkQueue, limits: Limits, metrics: Metrics) -> None:
        self._repository, self._work, self._limits, self._metrics = repository, work, limits, metrics
        self._guard = CallGuard(metrics)
        self._phases = [metrics.phases.labels(name) for name in ("queue", "decode", "inference")]
        self._num_streams, self._lock = 0, threading.Lock()
        metrics.streams.set_function(lambda: self._num_streams)

    def Detect(self, request: messages.DetectRequest, context: Context) -> messages.DetectResponse:
        body = partial(self._detect_in_slot, request, context)
        return self._guard.run("Detect", request.request_id[:_MAX_ID_LENGTH], context, body)

    def DetectStream(
        self, request_iterator: Iterator[messages.DetectRequest], context: Context
    ) -> Iterator[messages.DetectResponse]:
        self._guard.run("DetectStream", "", context, partial(self._open_stream, context))
        # One frame of a stream at a time: the next is read when this one is answered, so the client feels the load.
        for request in request_iterator:
            yield self._frame_of_stream(request, context)

    def ListModels(self, request: messages.ListModelsRequest, context: Context) -> messages.ListModelsResponse:
        return self._guard.run("ListModels", "", context, self._list)

    def GetModel(self, request: messages.GetModelRequest, context: Context) -> messages.GetModelResponse:
        return self._guard.run("GetModel", "", context, partial(self._get, request))

    def _frame_of_stream(self, request: messages.DetectRequest, context: Context) -> messages.DetectResponse:
        """One frame's answer, or why it has none; only what ends the call ends the stream."""
        request_id = request.request_id[:_MAX_ID_LENGTH]
        body = partial(self._detect_in_slot, request, context, always=True)
        answer = self._guard.attempt("DetectStream.frame", request_id, context, body)
        if isinstance(answer, CallEnded):
            context.abort_with_status(wire.status_from_error(answer))
        if isinstance(answer, CurioError):
            return messages.DetectResponse(request_id=request_id or new_request_id(), error=wire.frame_error(answer))
        return answer

    def _open_stream(self, context: Context) -> None:
        with self._lock:
            if self._num_streams >= self._limits.max_streams:
                raise Overloaded(f"{self._num_streams} streams are open, which is the limit (--max-streams)", 1.0)
            self._num_streams += 1
        if not context.add_callback(self._close_stream):
            self._close_stream()

    def _close_stream(self) -> None:
        with self._lock:
            self._num_streams -= 1

    def _list(self) -> messages.ListModelsResponse:
        answer = messages.ListModelsResponse()
        for name, loaded in self._repository:
            spec = loaded[max(loaded)].spec
            objects = [kind.name for kind in spec.objects]
            answer.models.add(name=name, versions=sorted(loaded), world=spec.world, objects=objects)
        return answer

    def _get(self, request: messages.GetModelRequest) -> messages.GetModelResponse:
        model = self._repository.get(request.model.name, request.model.version)
        return messages.GetModelResponse(spec=model.spec, version=model.version)

    def _detect_in_slot(
        self, request: messages.DetectRequest, context: Context, *, always: bool = False
    ) -> messages.DetectResponse:
        detectors = self._detectors(request)
        with self._work.slot(context, always=always) as waited_s:
            return self._detect(request, detectors, waited_s)

    def _detect(
        self, request: messages.DetectRequest, detectors: list[Detector], waited_s: float
    ) -> messages.DetectResponse:
        """Decode a request's frame and run the models on it.

        Raises:
            RequestError: The image, the camera or a region is not acceptable.
            InternalError: A network failed.
        """
        begun = time.perf_counter()
        limits = self._limits
        camera = wire.camera_from_message(request.camera) if request.HasField("camera") else None
        regions = list(map(wire.region_from_message, request.regions))
        min_confidence = request.min_confidence if request.HasField("min_confidence") else limits.min_confidence
        frame, camera = _decode(request, camera, detectors, limits)
        decoded = time.perf_counter()
        answer = messages.DetectResponse()
        for detector in detectors:
            detector.detect(
                frame.pixels,
                camera,
                regions=regions,
                min_confidence=min_confidence,
                max_detections=request.max_detections or None,
                reduction=frame.reduction,
                results=answer.results,
            )
        inferred = time.perf_counter()
        # Only now: what writes messages has gone cold by the time that a network has run.
        answer.request_id = request.request_id or new_request_id()
        answer.width, answer.height = frame.width, frame.height
        spent = answer.milliseconds
        spent.queue, spent.decode, spent.inference = waited_s * 1e3, (decoded - begun) * 1e3, (inferred - decoded) * 1e3
        for phase, seconds in zip(self._phases, (waited_s, decoded - begun, inferred - decoded), strict=True):
            phase.observe(seconds)
        return answer

    def _detectors(self, request: messages.DetectRequest) -> list[Detector]:
        """The models that a request names; refuses what can be refused without work."""
        limits, models, num_regions = self._limits, request.models, len(request.regions)
        if not 1 <= len(models) <= limits.max_models:
            raise ArgumentError(f"models names {len(models)} models; expected 1 to {limits.max_models} (--max-models)")
        if num_regions > limits.max_regions:
            raise ArgumentError(
                f"regions has {num_regions} entries; at most {limits.max_regions} are accepted (--max-regions)"
            )
        if len(request.request_id) > _MAX_ID_LENGTH:
            raise ArgumentError(f"request_id has {len(request.request_id)} characters; at most {_MAX_ID_LENGTH}")
        if request.HasField("max_detections") and not request.max_detections:
            raise ArgumentError("max_detections is 0; leave it out for no limit, or give at least 1")
        return [Detector(self._repository.get(model.name, model.version)) for model in models]


def new_request_id() -> str:
    """32 hexadecimal digits, of this process and this request alone."""
    return f"{_ID_PREFIX}{next(_ID_NUMBERS):016x}"


def _decode(
    request: messages.DetectRequest, camera: PinholeCamera | None, detectors: list[Detector], limits: Limits
) -> tuple[image.Frame, PinholeCamera | None]:
    kind = request.WhichOneof("image")
    if kind is None:
        raise ImageError("the request has no image; set encoded (JPEG, PNG, WebP) or raw")
    if kind == "raw":
        return wire.frame_from_raw(request.raw, limits.max_pixels), camera
    data = request.encoded  # each look at the field copies it
    header = image.open_header(data, limits.max_pixels)
    reductions = [1 if limits.full_decode else d.reduction(camera, header.width, header.height) for d in detectors]
    frame = image.decode(
        data,
        header=header,
        max_reduction=min(reductions),
        apply_exif_rotation=request.apply_exif_rotation,
    )
    if camera is not None and frame.quarter_turns:
        camera = camera.turned(frame.quarter_turns, header.width, header.height)
    return frame, camera
