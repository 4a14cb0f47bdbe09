"""KServe v2 on a real server: raw tensors give what the typed API gives."""

import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from curio_proto.inference import inference_pb2 as messages
from curio_proto.inference.inference_pb2_grpc import GRPCInferenceServiceStub
from curio_proto.v1 import detector_pb2 as pb
from curio_proto.v1.detector_pb2_grpc import PoseDetectorStub

CANONICAL_K = [110.0, 0, 50.0, 0, 112.0, 30.0, 0, 0, 1]
SHAPE = [1, 64, 96, 3]


@pytest.fixture(scope="module")
def channel(server: Any) -> Iterator[grpc.Channel]:
    with grpc.insecure_channel(server.address) as channel:
        yield channel


@pytest.fixture(scope="module")
def stub(channel: grpc.Channel) -> GRPCInferenceServiceStub:
    return GRPCInferenceServiceStub(channel)


@pytest.fixture(scope="module")
def picture(spot_image: Callable[..., np.ndarray]) -> np.ndarray:
    return spot_image(96, 64, 60, 20, 4, 4, (200, 100, 50))


def _request(name: str = "pinhole", **changes: Any) -> messages.ModelInferRequest:
    tensor = messages.ModelInferRequest.InferInputTensor(name="image", datatype="UINT8", shape=SHAPE)
    values = {"model_name": name, "id": "7", "inputs": [tensor], "raw_input_contents": [bytes(64 * 96 * 3)]}
    return messages.ModelInferRequest(**(values | changes))


def _outputs(answer: messages.ModelInferResponse) -> dict[str, np.ndarray]:
    return {
        output.name: np.frombuffer(data, "<f4").reshape(output.shape)
        for output, data in zip(answer.outputs, answer.raw_output_contents, strict=True)
    }


def test_the_same_pixels_give_the_same_pose(
    stub: GRPCInferenceServiceStub, channel: grpc.Channel, picture: np.ndarray
) -> None:
    answer = stub.ModelInfer(_request(raw_input_contents=[picture.tobytes()]), timeout=10)
    assert (answer.model_name, answer.model_version, answer.id) == ("pinhole", "1", "7")
    raw = pb.RawImage(format=pb.PIXEL_FORMAT_RGB8, width=96, height=64, data=picture.tobytes())
    typed = PoseDetectorStub(channel).Detect(
        pb.DetectRequest(
            models=[pb.ModelSelector(name="pinhole")], raw=raw, camera=pb.Camera(camera_matrix=CANONICAL_K)
        ),
        timeout=10,
    )
    [result] = typed.results
    [found] = result.detections
    outputs = _outputs(answer)
    np.testing.assert_allclose(outputs["translation_m"][0, 0], found.translation_m, atol=1e-4)
    np.testing.assert_allclose(outputs["rotation"][0, 0].ravel(), found.rotation, atol=1e-4)
    np.testing.assert_allclose(outputs["color"][0, 0], found.color, atol=1e-4)
    np.testing.assert_allclose(outputs["light"][0], result.light, atol=1e-4)


def test_typed_contents_are_the_same_as_raw_ones(stub: GRPCInferenceServiceStub, picture: np.ndarray) -> None:
    raw = stub.ModelInfer(_request(raw_input_contents=[picture.tobytes()]), timeout=10)
    request = _request(raw_input_contents=[])
    request.inputs[0].contents.uint_contents.extend(picture.ravel().tolist())
    assert stub.ModelInfer(request, timeout=10).raw_output_contents == raw.raw_output_contents


def test_a_batch_and_chosen_outputs(stub: GRPCInferenceServiceStub, picture: np.ndarray) -> None:
    request = _request(raw_input_contents=[bytes(picture.size) + picture.tobytes()])
    request.inputs[0].shape[0] = 2
    request.outputs.add(name="confidence")
    request.outputs.add(name="translation_m")
    answer = stub.ModelInfer(request, timeout=10)
    assert [output.name for output in answer.outputs] == ["confidence", "translation_m"]
    outputs = _outputs(answer)
    assert outputs["confidence"].shape == (2, 1)
    assert outputs["confidence"][0, 0] < 0.01 < 0.9 < outputs["confidence"][1, 0]


def test_server_and_models_describe_themselves(stub: GRPCInferenceServiceStub) -> None:
    assert stub.ServerLive(messages.ServerLiveRequest(), timeout=10).live
    assert stub.ServerReady(messages.ServerReadyRequest(), timeout=10).ready
    assert stub.ModelReady(messages.ModelReadyRequest(name="flat"), timeout=10).ready
    assert stub.ModelReady(messages.ModelReadyRequest(name="flat", version="1"), timeout=10).ready
    assert not stub.ModelReady(messages.ModelReadyRequest(name="flat", version="8"), timeout=10).ready
    assert not stub.ModelReady(messages.ModelReadyRequest(name="none"), timeout=10).ready
    assert stub.ServerMetadata(messages.ServerMetadataRequest(), timeout=10).name == "curio-serve"
    meta = stub.ModelMetadata(messages.ModelMetadataRequest(name="pinhole"), timeout=10)
    assert (meta.name, list(meta.versions), meta.platform) == ("pinhole", ["1"], "onnxruntime_onnx")
    assert [(i.name, i.datatype, list(i.shape)) for i in meta.inputs] == [("image", "UINT8", [-1, 64, 96, 3])]
    assert {(o.name, o.datatype, tuple(o.shape)) for o in meta.outputs} == {
        ("translation_m", "FP32", (-1, 1, 3)),
        ("color", "FP32", (-1, 1, 3)),
        ("confidence", "FP32", (-1, 1)),
        ("rotation_6d", "FP32", (-1, 1, 6)),
        ("rotation", "FP32", (-1, 1, 3, 3)),
        ("light", "FP32", (-1, 3)),
    }


def _tensor(**changes: Any) -> list[messages.ModelInferRequest.InferInputTensor]:
    values = {"name": "image", "datatype": "UINT8", "shape": SHAPE} | changes
    return [messages.ModelInferRequest.InferInputTensor(**values)]


@pytest.mark.parametrize(
    ("request_", "status", "words"),
    [
        (_request("none"), "NOT_FOUND", "loaded are"),
        (_request(model_version="9"), "NOT_FOUND", "no version 9"),
        (_request(model_version="-1"), "INVALID_ARGUMENT", "model version is '-1'"),
        (_request(model_version="٣"), "INVALID_ARGUMENT", "model version is"),
        (_request(inputs=[]), "INVALID_ARGUMENT", "inputs are"),
        (_request(inputs=_tensor(name="x")), "INVALID_ARGUMENT", "inputs are"),
        (_request(inputs=_tensor(datatype="FP32")), "INVALID_ARGUMENT", "inputs are"),
        (_request(inputs=_tensor(shape=[64, 96, 3])), "INVALID_ARGUMENT", "inputs are"),
        (_request(inputs=_tensor(shape=[])), "INVALID_ARGUMENT", "inputs are"),
        (_request(inputs=_tensor(shape=[0, 64, 96, 3])), "INVALID_ARGUMENT", "batch has 0"),
        (_request(inputs=_tensor(shape=[-1, 64, 96, 3])), "INVALID_ARGUMENT", "batch has -1"),
        (_request(inputs=_tensor(shape=[1 << 40, 64, 96, 3])), "INVALID_ARGUMENT", "batch has"),
        (_request(raw_input_contents=[b"short"]), "INVALID_ARGUMENT", r"\[5\] bytes"),
        (_request(raw_input_contents=[]), "INVALID_ARGUMENT", "uint_contents has 0 values"),
        (_request(outputs=[{"name": "pose"}]), "INVALID_ARGUMENT", r"outputs has \['pose'\]"),
        (_request(outputs=[{"name": "color"}] * 99), "INVALID_ARGUMENT", "outputs has 99 names"),
        (_request(outputs=[{"name": "color"}] * 2), "INVALID_ARGUMENT", "outputs has 2 names"),
    ],
)
def test_refusals(
    stub: GRPCInferenceServiceStub, request_: messages.ModelInferRequest, status: str, words: str
) -> None:
    with pytest.raises(grpc.RpcError, match=words) as caught:
        stub.ModelInfer(request_, timeout=10)
    assert caught.value.code().name == status
    assert stub.ModelInfer(_request(), timeout=10).outputs


def test_values_beyond_a_byte_are_refused(stub: GRPCInferenceServiceStub) -> None:
    request = _request(raw_input_contents=[])
    request.inputs[0].contents.uint_contents.extend([256] * (64 * 96 * 3))
    with pytest.raises(grpc.RpcError, match="from 0 to 255"):
        stub.ModelInfer(request, timeout=10)


@pytest.mark.parametrize("call", ["ModelConfig", "RepositoryIndex", "ModelStatistics", "RepositoryModelLoad"])
def test_calls_that_are_not_there_are_unimplemented(server: Any, call: str) -> None:
    """As docs/serving.md says of Triton's extensions."""
    with grpc.insecure_channel(server.address) as channel:
        ask = channel.unary_unary(f"/inference.GRPCInferenceService/{call}")
        with pytest.raises(grpc.RpcError) as refusal:
            ask(b"", timeout=10)
    assert refusal.value.code() is grpc.StatusCode.UNIMPLEMENTED


def test_tritonclient_works_unchanged(server: Any, picture: np.ndarray, tmp_path: Path) -> None:
    """In a process of its own, because two copies of the ``inference`` messages cannot be loaded together.

    CURIO_TRITON_PYTHON names an interpreter that has ``tritonclient[grpc]``.
    """
    python = os.environ.get("CURIO_TRITON_PYTHON")
    if not python:
        pytest.skip("CURIO_TRITON_PYTHON is not set; it names an interpreter with tritonclient[grpc]")
    np.save(tmp_path / "picture.npy", picture[None])
    code = """
import sys
import numpy as np
import tritonclient.grpc as triton

client = triton.InferenceServerClient(sys.argv[1])
assert client.is_server_live() and client.is_server_ready() and client.is_model_ready("pinhole")
assert client.get_model_metadata("pinhole").inputs[0].name == "image"
picture = np.load(sys.argv[2] + "/picture.npy")
image = triton.InferInput("image", list(picture.shape), "UINT8")
image.set_data_from_numpy(picture)
answer = client.infer("pinhole", [image], client_timeout=10)
np.save(sys.argv[2] + "/translation.npy", answer.as_numpy("translation_m"))
"""
    command = [python, "-c", code, server.address, str(tmp_path)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 0, ended.stderr
    with grpc.insecure_channel(server.address) as channel:
        request = _request(raw_input_contents=[picture.tobytes()])
        ours = _outputs(GRPCInferenceServiceStub(channel).ModelInfer(request, timeout=10))
    np.testing.assert_array_equal(np.load(tmp_path / "translation.npy"), ours["translation_m"])
