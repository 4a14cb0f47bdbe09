"""Requests nobody would write, on a real server: each gets a defined status, and the next good answer is right.

CURIO_FUZZ_EXAMPLES sets how many are tried by each test.
"""

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import grpc
import numpy as np
import pytest
from curio_proto.inference import inference_pb2 as inference
from curio_proto.inference.inference_pb2_grpc import GRPCInferenceServiceStub
from curio_proto.v1 import detector_pb2 as pb
from curio_proto.v1.detector_pb2_grpc import PoseDetectorStub
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

NUM_EXAMPLES = int(os.environ.get("CURIO_FUZZ_EXAMPLES", "150"))
DEFINED = {"OK", "INVALID_ARGUMENT", "FAILED_PRECONDITION", "NOT_FOUND"}
fuzz = settings(
    max_examples=NUM_EXAMPLES,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large],
)

_SCENE = cv2.resize(np.random.default_rng(0).integers(0, 255, (6, 8, 3)).astype(np.uint8), (96, 64))
_IMAGES = [cv2.imencode(suffix, _SCENE)[1].tobytes() for suffix in (".jpg", ".png", ".webp")]
_IMAGES.append(cv2.imencode(".jpg", _SCENE, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes())
# Messages as they travel, METHOD-WHAT.bin; benchmarks/load/fuzz_corpus.py writes them.
_CORPUS = sorted((Path(__file__).parent / "corpus").glob("*.bin"))
_PATHS = {
    "Detect": "/curio.v1.PoseDetector/Detect",
    "GetModel": "/curio.v1.PoseDetector/GetModel",
    "ModelInfer": "/inference.GRPCInferenceService/ModelInfer",
}


@pytest.fixture(scope="module")
def channel(server: Any) -> Iterator[grpc.Channel]:
    with grpc.insecure_channel(server.address) as channel:
        yield channel


def _status(call: Any, request: Any) -> str:
    try:
        call(request, timeout=20)
    except grpc.RpcError as exc:
        return exc.code().name
    return "OK"


def _check_next(channel: grpc.Channel) -> None:
    """A bright spot left of the middle is found there, whatever came before."""
    columns, rows = np.meshgrid(np.arange(96), np.arange(64))
    spot = np.round(255 * np.exp(-((columns - 30) ** 2 + (rows - 31.5) ** 2) / 30)).astype(np.uint8)
    raw = pb.RawImage(format=pb.PIXEL_FORMAT_GRAY8, width=96, height=64, data=spot.tobytes())
    answer = PoseDetectorStub(channel).Detect(
        pb.DetectRequest(models=[pb.ModelSelector(name="flat")], raw=raw), timeout=20
    )
    np.testing.assert_allclose(answer.results[0].detections[0].translation_m, [(30 - 47.5) / 96, 0, 0], atol=2e-3)


@st.composite
def damaged_images(draw: st.DrawFn) -> bytes:
    """A good file with bits flipped, bytes cut out or put in, or its end missing."""
    data = bytearray(draw(st.sampled_from(_IMAGES)))
    for _ in range(draw(st.integers(1, 6))):
        position = draw(st.integers(0, len(data) - 1))
        kind = draw(st.sampled_from(["flip", "cut", "insert", "end", "size"]))
        if kind == "flip":
            data[position] ^= 1 << draw(st.integers(0, 7))
        elif kind == "cut":
            del data[position : position + draw(st.integers(1, 20))]
        elif kind == "insert":
            data[position:position] = draw(st.binary(min_size=1, max_size=20))
        elif kind == "end":
            del data[position + 1 :]
        elif len(data) >= 24:
            # PNG's width and height, where a huge picture would hide.
            data[16:24] = struct.pack(">II", draw(st.integers(0, 2**32 - 1)), draw(st.integers(0, 2**32 - 1)))
        if not data:
            break
    return bytes(data)


@fuzz
@given(damaged_images(), st.booleans())
def test_damaged_images(channel: grpc.Channel, data: bytes, apply_exif_rotation: bool) -> None:
    request = pb.DetectRequest(
        models=[pb.ModelSelector(name="flat")], encoded=data, apply_exif_rotation=apply_exif_rotation
    )
    assert _status(PoseDetectorStub(channel).Detect, request) in {"OK", "INVALID_ARGUMENT"}
    _check_next(channel)


numbers = st.one_of(
    st.floats(width=32), st.sampled_from([0.0, -1.0, 1e-30, 1e30, float("nan"), float("inf"), 320.0, 600.0])
)
names = st.one_of(
    st.sampled_from(["flat", "pinhole", "", "../flat", "flat\0", "flat/1", "a" * 5000]), st.text(max_size=20)
)
models = st.builds(pb.ModelSelector, name=names, version=st.integers(0, 2**32 - 1) | st.sampled_from([0, 1]))
cameras = st.none() | st.builds(
    pb.Camera,
    camera_matrix=st.lists(numbers, max_size=10)
    | st.builds(lambda f, x, y: [f, 0, x, 0, f, y, 0, 0, 1], numbers, numbers, numbers),
    distortion=st.lists(numbers, max_size=9),
)
regions = st.builds(pb.Region, x=numbers, y=numbers, width=numbers, height=numbers)
sides = st.integers(0, 2**32 - 1) | st.integers(0, 100)
raws = st.builds(
    pb.RawImage, format=st.integers(0, 9), width=sides, height=sides, stride=sides, data=st.binary(max_size=4000)
) | st.builds(
    lambda fmt, w, h: pb.RawImage(format=fmt, width=w, height=h, data=bytes(w * h * (1 if fmt == 3 else 3))),
    st.integers(1, 3), st.integers(16, 300), st.integers(16, 300),
)  # fmt: skip


@fuzz
@given(
    st.lists(models, max_size=4) | st.just([pb.ModelSelector(name="pinhole")]),
    raws,
    cameras,
    st.lists(regions, max_size=5),
    st.none() | numbers,
    st.none() | st.integers(0, 2**32 - 1),
    st.text(max_size=200),
)
def test_strange_fields(
    channel: grpc.Channel,
    models: list[pb.ModelSelector],
    raw: pb.RawImage,
    camera: pb.Camera | None,
    regions: list[pb.Region],
    min_confidence: float | None,
    max_detections: int | None,
    request_id: str,
) -> None:
    request = pb.DetectRequest(
        request_id=request_id,
        models=models,
        raw=raw,
        camera=camera,
        regions=regions,
        min_confidence=min_confidence,
        max_detections=max_detections,
    )
    assert _status(PoseDetectorStub(channel).Detect, request) in DEFINED
    _check_next(channel)


tensors = st.builds(
    inference.ModelInferRequest.InferInputTensor,
    name=st.sampled_from(["image", "", "x"]),
    datatype=st.sampled_from(["UINT8", "FP32", "BYTES", ""]),
    shape=st.lists(st.integers(-(2**63), 2**63 - 1), max_size=5) | st.just([1, 64, 96, 3]),
)


@fuzz
@given(
    names,
    st.text(max_size=12) | st.sampled_from(["", "1", "0", "-1", "99999999999999999999"]),
    st.lists(tensors, max_size=3),
    st.lists(st.binary(max_size=100) | st.just(bytes(64 * 96 * 3)), max_size=2),
    st.lists(st.sampled_from(["color", "pose", ""]), max_size=4),
)
def test_strange_tensors(
    channel: grpc.Channel,
    name: str,
    version: str,
    inputs: list[inference.ModelInferRequest.InferInputTensor],
    contents: list[bytes],
    outputs: list[str],
) -> None:
    request = inference.ModelInferRequest(
        model_name=name,
        model_version=version,
        inputs=inputs,
        raw_input_contents=contents,
        outputs=[inference.ModelInferRequest.InferRequestedOutputTensor(name=output) for output in outputs],
    )
    assert _status(GRPCInferenceServiceStub(channel).ModelInfer, request) in DEFINED
    _check_next(channel)


@fuzz
@given(st.sampled_from(["Detect", "ListModels", "GetModel"]), st.binary(max_size=300))
@example("Detect", b"\xff" * 50)
@example("GetModel", b"\x0a\x05\x0a\xff\xff\xff\xff")
def test_messages_that_are_none(channel: grpc.Channel, method: str, data: bytes) -> None:
    call = channel.unary_unary(f"/curio.v1.PoseDetector/{method}")
    assert _status(call, data) in DEFINED
    _check_next(channel)


@pytest.mark.parametrize("path", _CORPUS, ids=[path.stem for path in _CORPUS])
def test_the_corpus(channel: grpc.Channel, path: Path) -> None:
    method = path.name.partition("-")[0]
    assert _status(channel.unary_unary(_PATHS[method]), path.read_bytes()) == "INVALID_ARGUMENT"
    _check_next(channel)


def test_the_corpus_is_there() -> None:
    assert {path.name.partition("-")[0] for path in _CORPUS} == _PATHS.keys()
