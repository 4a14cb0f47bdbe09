"""Answers the typed API ``curio.v1.PoseDetector`` by calling the detector."""

import itertools
import secrets
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import grpc
from curio_proto.v1 import detector_pb2 as messages
from curio_proto.v1.detector_pb2_grpc import PoseDetectorServicer

from curio_serve.api.admission import WorkQueue, check_is_wanted
from curio_serve.api.messages import camera_from_message, frame_from_raw, plane_from_message, region_from_message
from curio_serve.api.registration import only_message
from curio_serve.api.rig_request import check_views, refuse_many_pixels, rig_view
from curio_serve.api.status import CallLog, frame_error
from curio_serve.api.streams import Streams
from curio_serve.errors import ArgumentError, CallEnded, CurioError, ImageError, ModelNotFound, Unavailable
from curio_serve.imaging import image
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.models.detector import Detector, check_min_confidence
from curio_serve.models.model import Model, answering
from curio_serve.models.repository import Repository
from curio_serve.rigs.detect_views import detect_views
from curio_serve.telemetry import Metrics
from curio_serve.tracking.stream import FollowingStream

Context = grpc.ServicerContext
_MAX_ID_LENGTH = 128
_NOT_WITH_TRACK = ("max_detections", "max_instances", "reads")
_ID_PREFIX, _ID_NUMBERS = secrets.token_hex(8), itertools.count()


@dataclass(frozen=True)
class Limits:
    """The most that a request may ask for; names are those of the server's settings."""

    max_pixels: int = image.MAX_PIXELS
    max_regions: int = 64
    max_models: int = 16
    max_streams: int = 256
    min_confidence: float = 0.0
    full_decode: bool = False


class PoseService(PoseDetectorServicer):
    """Answers ``PoseDetector``'s calls, each on a thread of its own."""

    def __init__(self, repository: Repository, work: WorkQueue, limits: Limits, metrics: Metrics) -> None:
        self._repository, self._work, self._limits, self._metrics = repository, work, limits, metrics
        self._calls = CallLog(metrics)
        self._streams = Streams(limits.max_streams)
        metrics.streams.set_function(lambda: len(self._streams))

    def Detect(self, requests: Iterator[messages.DetectRequest], context: Context) -> messages.DetectResponse:
        """Answer the request of a unary call; a full queue refuses it before its message is read."""
        with self._calls.record("Detect", context) as call, self._work.reserve(context) as entry:
            request = only_message(requests)
            call.request_id = request.request_id
            detectors = self._detectors(request)
            with self._work.slot(context, entry) as waited_s:
                return self._detect(request, detectors, waited_s, context)

    def DetectStream(
        self, requests: Iterator[messages.DetectRequest], context: Context
    ) -> Iterator[messages.DetectResponse]:
        with self._calls.record("DetectStream", context):
            stream, following = self._streams.open(context), FollowingStream()
            # One frame of a stream at a time: the next is read when this one is answered, so the client feels the load.
            for request in requests:
                stream.works()
                yield self._frame_of_stream(request, following, context)
                stream.waits()
                if self._streams.are_ending:
                    raise Unavailable("the server stops; open the stream again, and send what has no answer yet")

    def end_streams(self, *, idle_alone: bool) -> None:
        """End streams, because the server stops: those that wait for a frame, or each after its frame."""
        self._streams.are_ending = not idle_alone
        self._streams.end_idle()

    def ListModels(self, request: messages.ListModelsRequest, context: Context) -> messages.ListModelsResponse:
        with self._calls.record("ListModels", context):
            return self._list()

    def GetModel(self, request: messages.GetModelRequest, context: Context) -> messages.GetModelResponse:
        with self._calls.record("GetModel", context):
            model = self._repository.get(request.model.name, request.model.version)
            return messages.GetModelResponse(spec=model.spec, version=model.version)

    def _frame_of_stream(
        self, request: messages.DetectRequest, following: FollowingStream, context: Context
    ) -> messages.DetectResponse:
        """One frame's answer, or its error; only the end of the call ends the stream."""
        try:
            with self._calls.record("DetectStream.frame", context) as call:
                call.request_id = request.request_id
                detectors = self._detectors(request, following)
                with self._work.slot(context, always=True) as waited_s:
                    return self._detect(request, detectors, waited_s, context, following)
        except CallEnded:
            raise
        except CurioError as exc:
            request_id = request.request_id[:_MAX_ID_LENGTH] or new_request_id()
            return messages.DetectResponse(request_id=request_id, error=frame_error(exc))

    def _list(self) -> messages.ListModelsResponse:
        answer = messages.ListModelsResponse()
        for name, loaded in self._repository:
            spec = loaded[max(loaded)].spec
            objects = [kind.name for kind in spec.objects]
            answer.models.add(name=name, versions=sorted(loaded), world=spec.world, objects=objects)
        return answer

    def _detect(
        self,
        request: messages.DetectRequest,
        detectors: list[Detector],
        waited_s: float,
        context: Context,
        following: FollowingStream | None = None,
    ) -> messages.DetectResponse:
        """Decode a request's frame and run the models on it, or follow their objects in a stream.

        Raises:
            CallEnded: The deadline passed, or the client or the server ended the call, before the last run.
            RequestError: The image, the camera or a region is not acceptable.
            InternalError: A network failed.
        """
        begun = time.perf_counter()
        limits = self._limits
        regions = list(map(region_from_message, request.regions))
        min_confidence = request.min_confidence if request.HasField("min_confidence") else limits.min_confidence
        check_min_confidence(min_confidence)
        plane = plane_from_message(request.plane) if request.HasField("plane") else None
        if request.views:
            return self._detect_views(request, detectors, waited_s, context)
        if request.HasField("track"):
            _check_following(request, following).check(request.track)
        frame, camera = _decode(request, detectors, limits, apply_exif_rotation=request.apply_exif_rotation)
        decoded = time.perf_counter()
        answer, before_run = messages.DetectResponse(), partial(check_is_wanted, context)
        if request.HasField("track"):
            _check_following(request, following).follow(
                request.track,
                detectors,
                frame.pixels,
                camera,
                min_confidence=min_confidence,
                plane=plane,
                reduction=frame.reduction,
                results=answer.results,
                before_run=before_run,
            )
        else:
            for detector in detectors:
                detector.detect(
                    frame.pixels,
                    camera,
                    regions=regions,
                    min_confidence=min_confidence,
                    max_detections=request.max_detections or None,
                    max_instances=request.max_instances if request.HasField("max_instances") else None,
                    plane=plane,
                    reduction=frame.reduction,
                    results=answer.results,
                    before_run=before_run,
                )
        self._finish(answer, request, frame, (begun, decoded, waited_s))
        return answer

    def _detect_views(
        self, request: messages.DetectRequest, detectors: list[Detector], waited_s: float, context: Context
    ) -> messages.DetectResponse:
        """Decode the views of a rig, which are in memory together, and find the poses that explain all of them.

        Raises:
            As :meth:`_detect`.
        """
        begun, limits = time.perf_counter(), self._limits
        check_views(request, len(detectors), max(limits.max_models, limits.max_regions))
        views, frames = [], []
        for number, view in enumerate(request.views):
            frame, camera = _decode(view, detectors, limits)
            views.append(rig_view(request, number, frame, camera, detectors))
            frames.append(frame)
            refuse_many_pixels(views, limits.max_pixels)
        decoded, answer = time.perf_counter(), messages.DetectResponse()
        for detector in detectors:
            detect_views(
                detector,
                views,
                min_confidence=request.min_confidence if request.HasField("min_confidence") else limits.min_confidence,
                max_detections=request.max_detections or None,
                results=answer.results,
                before_run=partial(check_is_wanted, context),
            )
        self._finish(answer, request, frames[0], (begun, decoded, waited_s))
        return answer

    def _finish(
        self,
        answer: messages.DetectResponse,
        request: messages.DetectRequest,
        frame: image.Frame,
        times_s: tuple[float, float, float],
    ) -> None:
        """Fill in the fields of an answer that no model writes, and count it; ``times_s``: begun, decoded, waited."""
        begun, decoded, waited_s = times_s
        inferred = time.perf_counter()
        # Only now: what writes messages has gone cold by the time that a network has run.
        answer.request_id = request.request_id or new_request_id()
        answer.width, answer.height = frame.width, frame.height
        spent = answer.milliseconds
        spent.queue, spent.decode, spent.inference = waited_s * 1e3, (decoded - begun) * 1e3, (inferred - decoded) * 1e3
        self._metrics.queue_s.observe(waited_s)
        self._metrics.decode_s.observe(decoded - begun)
        self._metrics.inference_s.observe(inferred - decoded)

    def _detectors(self, request: messages.DetectRequest, following: FollowingStream | None = None) -> list[Detector]:
        """The models that a request names. Requests that can be refused without work are refused here."""
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
        most_runs, num_instances = max(limits.max_models, limits.max_regions), request.max_instances or 1
        num_reads = request.reads if request.HasField("reads") else 1
        if (num_runs := len(models) * max(num_regions, 1) * num_instances * num_reads) > most_runs:
            times = f" times {num_instances} instances" if num_instances > 1 else ""
            times += f" times {num_reads} reads" if num_reads > 1 else ""
            raise ArgumentError(
                f"{len(models)} models times {max(num_regions, 1)} regions{times} are {num_runs} runs of a network; "
                f"at most {most_runs} are accepted (the larger of --max-models and --max-regions)"
            )
        found = [self._model(model, following) for model in models]
        if len(set(found)) < len(found):
            raise ArgumentError("models names a model more than once; expected each once")
        return [Detector(model, num_reads) for model in answering(found, request.objects)]

    def _model(self, wanted: messages.ModelSelector, following: FollowingStream | None) -> Model:
        """A model of a request; a stream keeps the version that it began with for as long as that is served."""
        if wanted.version or following is None:
            return self._repository.get(wanted.name, wanted.version)
        try:
            found = self._repository.get(wanted.name, following.versions.get(wanted.name, 0))
        except ModelNotFound:
            found = self._repository.get(wanted.name)
        following.versions[wanted.name] = found.version
        return found


def _check_following(request: messages.DetectRequest, following: FollowingStream | None) -> FollowingStream:
    """The stream's memory.

    Raises:
        ArgumentError: The request is none of a stream, or asks for what is not for following.
    """
    if following is None:
        raise ArgumentError("track is set in a single call; objects are followed in DetectStream")
    if request.regions or any(map(request.HasField, _NOT_WITH_TRACK)):
        raise ArgumentError(
            "regions, max_detections, max_instances and reads are not for following; leave them out, or leave out track"
        )
    return following


def new_request_id() -> str:
    """32 hexadecimal digits, of this process and this request alone."""
    return f"{_ID_PREFIX}{next(_ID_NUMBERS):016x}"


def _decode(
    request: messages.DetectRequest | messages.View,
    detectors: list[Detector],
    limits: Limits,
    *,
    apply_exif_rotation: bool = False,
) -> tuple[image.Frame, PinholeCamera | None]:
    camera = camera_from_message(request.camera) if request.HasField("camera") else None
    kind = request.WhichOneof("image")
    if kind is None:
        raise ImageError("the request, or one of its views, has no image; set encoded (JPEG, PNG, WebP) or raw")
    if kind == "raw":
        return frame_from_raw(request.raw, limits.max_pixels), camera
    data = request.encoded  # each look at the field copies it
    header = image.open_header(data, limits.max_pixels)
    reductions = [1 if limits.full_decode else d.reduction(camera, header.width, header.height) for d in detectors]
    frame = image.decode(
        data,
        header=header,
        max_reduction=min(reductions),
        apply_exif_rotation=apply_exif_rotation,
    )
    if camera is not None and frame.quarter_turns:
        camera.check_frame(header.width, header.height)  # before the size that it knows is turned, too
        camera = camera.turned(frame.quarter_turns, header.width, header.height)
    return frame, camera
