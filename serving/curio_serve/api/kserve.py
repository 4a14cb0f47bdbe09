"""KServe v2 / Open Inference Protocol on the same port: raw tensors in, the model's outputs out.

For clients that bring their own preprocessing, ``tritonclient`` for one. The image has to be of the model's own size
and camera already; :mod:`curio_serve.api.pose_detector` is the way for frames as cameras give them.
"""

from collections.abc import Iterator
from importlib.metadata import version as installed_version

import numpy as np
from curio_proto.inference import inference_pb2 as messages
from curio_proto.inference.inference_pb2_grpc import GRPCInferenceServiceServicer

from curio_serve.api.admission import WorkQueue
from curio_serve.api.pose_detector import Context
from curio_serve.api.registration import only_message
from curio_serve.api.status import CallLog
from curio_serve.errors import ArgumentError, ModelNotFound
from curio_serve.models.model import INPUT, Model, Outputs
from curio_serve.models.repository import Repository
from curio_serve.telemetry import Metrics

_MAX_BATCH = 64
_FP32 = np.dtype("<f4")


class InferenceService(GRPCInferenceServiceServicer):
    """Answers ``inference.GRPCInferenceService``."""

    def __init__(self, repository: Repository, work: WorkQueue, metrics: Metrics) -> None:
        self._repository, self._work = repository, work
        self._calls = CallLog(metrics)
        self._is_ready = True

    def drain(self) -> None:
        """Answer "not ready" from now on."""
        self._is_ready = False

    def ServerLive(self, request: messages.ServerLiveRequest, context: Context) -> messages.ServerLiveResponse:
        return messages.ServerLiveResponse(live=True)

    def ServerReady(self, request: messages.ServerReadyRequest, context: Context) -> messages.ServerReadyResponse:
        return messages.ServerReadyResponse(ready=self._is_ready and any(True for _ in self._repository))

    def ModelReady(self, request: messages.ModelReadyRequest, context: Context) -> messages.ModelReadyResponse:
        with self._calls.record("ModelReady", context):
            return self._model_ready(request)

    def ServerMetadata(
        self, request: messages.ServerMetadataRequest, context: Context
    ) -> messages.ServerMetadataResponse:
        return messages.ServerMetadataResponse(name="curio-serve", version=installed_version("curio-pose"))

    def ModelMetadata(self, request: messages.ModelMetadataRequest, context: Context) -> messages.ModelMetadataResponse:
        with self._calls.record("ModelMetadata", context):
            return self._metadata(request)

    def ModelInfer(
        self, requests: Iterator[messages.ModelInferRequest], context: Context
    ) -> messages.ModelInferResponse:
        """Answer the one request; a full queue refuses it before it is read."""
        with self._calls.record("ModelInfer", context) as call, self._work.reserve(context) as entry:
            request = only_message(requests)
            call.request_id = request.id
            with self._work.slot(context, entry):
                return self._infer(request)

    def _model_ready(self, request: messages.ModelReadyRequest) -> messages.ModelReadyResponse:
        try:
            self._repository.get(request.name, _version(request.version))
        except ModelNotFound:
            return messages.ModelReadyResponse(ready=False)
        return messages.ModelReadyResponse(ready=self._is_ready)

    def _metadata(self, request: messages.ModelMetadataRequest) -> messages.ModelMetadataResponse:
        model = self._repository.get(request.name, _version(request.version))
        loaded = dict(self._repository).get(model.name, {model.version: model})  # which may just have been removed
        answer = messages.ModelMetadataResponse(
            name=model.name, versions=[str(v) for v in sorted(loaded)], platform="onnxruntime_onnx"
        )
        answer.inputs.add(name=INPUT, datatype="UINT8", shape=[-1, *_input_shape(model)])
        for name, shape in model.output_shapes.items():
            answer.outputs.add(name=name, datatype="FP32", shape=[-1, *shape])
        return answer

    def _infer(self, request: messages.ModelInferRequest) -> messages.ModelInferResponse:
        model = self._repository.get(request.model_name, _version(request.model_version))
        images = _images(request, model)
        names = [output.name for output in request.outputs] or list(model.output_names)
        if (unknown := set(names) - set(model.output_names)) or len(names) > len(set(names)):
            found = sorted(unknown)[:4] or f"{len(names)} names"
            raise ArgumentError(f"outputs has {found}; model {model.label} has each of {model.output_names} once")
        return _answer(request.id, model, names, model.run(images))


def _version(text: str) -> int:
    """Version of a request; empty: the latest.

    Raises:
        ArgumentError: Not a number.
    """
    if not text:
        return 0
    if not (text.isascii() and text.isdecimal() and len(text) <= 9 and int(text)):
        raise ArgumentError(f"model version is {text[:32]!r}; expected a number from 1, or nothing for the latest")
    return int(text)


def _input_shape(model: Model) -> tuple[int, int, int]:
    return model.camera.height, model.camera.width, 3


def _images(request: messages.ModelInferRequest, model: Model) -> np.ndarray:
    """The one input tensor, uint8 [batch, height, width, 3].

    Raises:
        ArgumentError: Another name, type or shape, or bytes that do not fit them.
    """
    shape = (-1, *_input_shape(model))
    found = [(i.name, i.datatype, list(i.shape)) for i in request.inputs]
    if len(found) != 1 or found[0][:2] != (INPUT, "UINT8") or tuple(found[0][2][1:]) != shape[1:]:
        raise ArgumentError(f"inputs are {found[:4]}; model {model.label} takes {[(INPUT, 'UINT8', list(shape))]}")
    num_images = found[0][2][0]
    if not 1 <= num_images <= _MAX_BATCH:
        raise ArgumentError(f"the batch has {num_images} images; expected 1 to {_MAX_BATCH}")
    num_bytes = num_images * int(np.prod(shape[1:]))
    if request.raw_input_contents:
        data = request.raw_input_contents[0]
        if len(request.raw_input_contents) != 1 or len(data) != num_bytes:
            sizes = [len(d) for d in request.raw_input_contents[:4]]
            raise ArgumentError(f"raw_input_contents has {sizes} bytes; expected one entry of {num_bytes}")
        return np.frombuffer(data, np.uint8).reshape(shape)
    values = np.array(request.inputs[0].contents.uint_contents, np.uint32)
    if len(values) != num_bytes or values.max() > 255:
        raise ArgumentError(f"contents.uint_contents has {len(values)} values; expected {num_bytes} from 0 to 255")
    return values.astype(np.uint8).reshape(shape)


def _answer(request_id: str, model: Model, names: list[str], outputs: Outputs) -> messages.ModelInferResponse:
    answer = messages.ModelInferResponse(model_name=model.name, model_version=str(model.version), id=request_id)
    for name in names:
        answer.outputs.add(name=name, datatype="FP32", shape=outputs[name].shape)
        answer.raw_output_contents.append(outputs[name].astype(_FP32, copy=False).tobytes())
    return answer
