"""A message split by hand must say what protobuf reads in it."""

import pytest
from curio_proto.v1 import detector_pb2 as pb
from curio_serve.large_field import take_out
from curio_serve.wire import FrameRequest
from google.protobuf.message import DecodeError
from hypothesis import given
from hypothesis import strategies as st

NUMBER = pb.DetectRequest.ENCODED_FIELD_NUMBER

requests = st.builds(
    pb.DetectRequest,
    request_id=st.text(max_size=5),
    models=st.lists(st.builds(pb.ModelSelector, name=st.text(max_size=3), version=st.integers(0, 2**32 - 1))),
    encoded=st.binary(max_size=300),
    camera=st.none() | st.builds(pb.Camera, camera_matrix=st.lists(st.floats(allow_nan=False), max_size=9)),
    min_confidence=st.none() | st.floats(0, 1, width=32),
    max_detections=st.none() | st.integers(0, 2**32 - 1),
    apply_exif_rotation=st.booleans(),
)


def test_the_image_is_a_view_and_the_rest_is_all_else() -> None:
    message = pb.DetectRequest(request_id="one", encoded=b"picture", apply_exif_rotation=True)
    data = message.SerializeToString()
    rest, value = take_out(data, NUMBER) or (b"", memoryview(b""))
    assert value == b"picture"
    assert value.obj is data
    message.ClearField("encoded")
    assert rest == message.SerializeToString()


@given(requests)
def test_a_request_says_the_same_split_and_whole(message: pb.DetectRequest) -> None:
    read = FrameRequest.parse(message.SerializeToString())
    assert read.encoded is not None
    assert bytes(read.encoded) == message.encoded
    read.message.encoded = bytes(read.encoded)
    assert read.message == message


@given(requests, st.data())
def test_damaged_bytes_mean_what_they_mean_to_protobuf(message: pb.DetectRequest, data: st.DataObject) -> None:
    whole = bytearray(message.SerializeToString())
    place = data.draw(st.integers(0, len(whole) - 1))
    damaged = bytes(whole[:place] + data.draw(st.binary(max_size=3)) + whole[place + data.draw(st.integers(0, 3)) :])
    try:
        expected = pb.DetectRequest.FromString(damaged)
    except DecodeError:
        with pytest.raises(DecodeError):
            FrameRequest.parse(damaged)
        return
    read = FrameRequest.parse(damaged)
    assert read.message.HasField("raw") == expected.HasField("raw")
    assert (read.encoded is not None) == expected.HasField("encoded")
    assert bytes(read.encoded or b"") == expected.encoded
    for field in ("request_id", "models", "camera", "regions", "max_detections"):
        assert getattr(read.message, field) == getattr(expected, field)


@pytest.mark.parametrize(
    "parts",
    [
        [pb.DetectRequest(request_id="none")],
        [pb.DetectRequest(encoded=b"first"), pb.DetectRequest(encoded=b"second")],
        [pb.DetectRequest(encoded=b"first"), pb.DetectRequest(raw=pb.RawImage(width=3))],
        [pb.DetectRequest(raw=pb.RawImage(width=3)), pb.DetectRequest(encoded=b"second")],
    ],
    ids=["no image", "twice", "then raw", "raw before"],
)
def test_the_last_image_counts(parts: list[pb.DetectRequest]) -> None:
    data = b"".join(part.SerializeToString() for part in parts)
    expected = FrameRequest.of(pb.DetectRequest.FromString(data))
    assert FrameRequest.parse(data) == expected


@pytest.mark.parametrize("data", [b"\x1a", b"\x1a\x05ab", b"\x80" * 11, b"\x1a\x01a\x0b", b"\x1a\x01a\x09\x00"])
def test_odd_messages_are_left_to_protobuf(data: bytes) -> None:
    assert take_out(data, NUMBER) is None
