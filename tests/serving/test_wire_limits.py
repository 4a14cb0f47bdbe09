"""Messages are counted before they are parsed: a few bytes on the wire may unfold to gigabytes."""

import tracemalloc

import pytest
from curio_proto.inference.inference_pb2 import ModelInferRequest
from curio_proto.v1.detector_pb2 import Camera, DetectRequest, ModelSelector, Region
from curio_serve.api.messages import camera_from_message
from curio_serve.api.wire_limits import MAX_FIELDS, MAX_NUMBERS, check_counts
from curio_serve.errors import ArgumentError
from google.protobuf.message import Message

Tensor = ModelInferRequest.InferInputTensor


def _check(message: Message, more: bytes = b"") -> None:
    check_counts(message.DESCRIPTOR, message.SerializeToString() + more)


@pytest.mark.parametrize(
    "tag", [b"\x12\x00", b"\x32\x00", b"\x2a\x02\x09\x00", b"\x7a\x00", b"\x0b\x0c", b"\x78\x00"],
    ids=["models", "regions", "matrix in pieces", "unknown", "groups", "unknown numbers"],
)  # fmt: skip
def test_many_small_fields_of_detect(tag: bytes) -> None:
    with pytest.raises(ArgumentError, match="more than 4096 fields"):
        _check(DetectRequest(), tag * MAX_FIELDS * 2)
    _check(DetectRequest(), tag * 1000)


@pytest.mark.parametrize("tag", [b"\x2a\x00", b"\x32\x00", b"\x3a\x00", b"\x22\x00", b"\x2a\x02\x22\x00"])
def test_many_small_fields_of_infer(tag: bytes) -> None:
    with pytest.raises(ArgumentError, match="more than 4096 fields"):
        _check(ModelInferRequest(), tag * MAX_FIELDS * 2)


def test_many_numbers() -> None:
    with pytest.raises(ArgumentError, match="numbers in lists"):
        _check(ModelInferRequest(inputs=[Tensor(shape=[1] * (MAX_NUMBERS + 1))]))
    with pytest.raises(ArgumentError, match="numbers in lists"):
        _check(DetectRequest(camera=Camera(camera_matrix=[1.0] * (MAX_NUMBERS + 1))))


def test_what_clients_send_passes() -> None:
    regions = [Region(x=1, y=2, width=3, height=4)] * 64
    models = [ModelSelector(name=f"model-{number}", version=2) for number in range(16)]
    camera = Camera(camera_matrix=[1.0] * 9, distortion=[0.1] * 5)
    # The bytes of an image are no fields.
    _check(DetectRequest(request_id="a", models=models, encoded=b"\x12\x00" * 500_000, camera=camera, regions=regions))
    _check(ModelInferRequest(inputs=[Tensor(name="image", shape=[64, 64, 96, 3])], raw_input_contents=[bytes(10**6)]))
    contents = {"contents": {"uint_contents": range(10**5)}}
    _check(ModelInferRequest(inputs=[Tensor(name="image", shape=[1, 64, 96, 3], **contents)]))


@pytest.mark.parametrize("data", [b"\xff" * 50, b"\x0a\xff\xff\xff\xff\x0f", b"\x12", b"\x07\x07", b"\x12\x05\x0a"])
def test_what_is_no_message_is_left_to_the_parser(data: bytes) -> None:
    check_counts(DetectRequest.DESCRIPTOR, data)


def test_what_a_message_holds_beside_a_camera_is_not_kept() -> None:
    """Cameras of requests are remembered; fields of later versions may be of any size."""
    camera = Camera(camera_matrix=[500, 0, 320, 0, 500, 240, 0, 0, 1], width=640, height=480).SerializeToString()
    tracemalloc.start()
    for number in range(20):
        unknown = b"\x82\x7d" + b"\x80\x80\x40" + bytes([number]) * (1 << 20)  # field 2000, 1 MiB
        camera_from_message(Camera.FromString(camera + unknown))
        del unknown
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < 1 << 20
