"""Calls on a narrow server: refused before their message is read, dropped from the queue, and beside streams."""

import threading
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import cv2
import grpc
import numpy as np
import pytest
from curio_proto.v1 import detector_pb2 as pb
from curio_proto.v1.detector_pb2_grpc import PoseDetectorStub
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import ProtoReflectionDescriptorDatabase

DETECT = "/curio.v1.PoseDetector/Detect"
FLAT = pb.ModelSelector(name="flat")
SMALL = pb.RawImage(format=pb.PIXEL_FORMAT_GRAY8, width=96, height=64, data=bytes(96 * 64))
QUICK = pb.DetectRequest(models=[FLAT], raw=SMALL)


@pytest.fixture(scope="module")
def slow() -> pb.DetectRequest:
    """A frame that takes long to decode: 25 million pixels in a small file."""
    data = cv2.imencode(".png", np.zeros((5000, 5000), np.uint8))[1].tobytes()
    return pb.DetectRequest(models=[FLAT], encoded=data)


@pytest.fixture(scope="module")
def narrow(start_server: Callable[..., Any], models_dir: Any) -> Any:
    """A server that works on one frame at a time and lets two wait."""
    return start_server(models_dir, "--workers", "1", "--queue", "2", "--metrics-port", "0")


@pytest.fixture
def channel(narrow: Any) -> Iterator[grpc.Channel]:
    with grpc.insecure_channel(narrow.address) as channel:
        yield channel


def _metric(server: Any, name: str) -> float:
    with urllib.request.urlopen(server.metrics_url, timeout=10) as page:
        lines = [line.rpartition(" ") for line in page.read().decode().splitlines()]
    return next((float(value) for found, _, value in lines if found == name), 0.0)


def _fill(server: Any, channel: grpc.Channel, request: pb.DetectRequest) -> list[Any]:
    """One call that works and two that wait."""
    calls = []
    for names in ("curio_working", "curio_queue_length", "curio_queue_length"):
        before = _metric(server, names)
        calls.append(PoseDetectorStub(channel).Detect.future(request, timeout=60))
        while _metric(server, names) <= before:
            assert not calls[0].done()
    return calls


def test_a_call_is_refused_before_its_message(narrow: Any, channel: grpc.Channel, slow: pb.DetectRequest) -> None:
    over = threading.Event()

    def never() -> Iterator[bytes]:
        over.wait(60)
        yield from ()

    refusals = 'curio_requests_total{code="RESOURCE_EXHAUSTED",method="Detect"}'
    before = _metric(narrow, refusals)
    calls = _fill(narrow, channel, slow)
    try:
        with pytest.raises(grpc.RpcError, match="1 requests are being worked on and 2 are waiting") as caught:
            channel.stream_unary(DETECT)(never(), timeout=60)
        assert caught.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
        assert "google.rpc.retryinfo" in str(caught.value.trailing_metadata()).lower()
        # What tells operators how the server is does not queue.
        health = health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest(), timeout=10)
        assert health.status == health_pb2.HealthCheckResponse.SERVING
        assert "curio.v1.PoseDetector" in ProtoReflectionDescriptorDatabase(channel).get_services()
    finally:
        over.set()
    assert [call.result().width for call in calls] == [5000] * 3
    assert _metric(narrow, refusals) == before + 1


def test_a_cancelled_call_leaves_the_queue(narrow: Any, channel: grpc.Channel, slow: pb.DetectRequest) -> None:
    cancelled = 'curio_requests_total{code="CANCELLED",method="Detect"}'
    before = _metric(narrow, cancelled)
    first, second, third = _fill(narrow, channel, slow)
    third.cancel()
    while _metric(narrow, cancelled) == before:
        assert not second.done()
    # Its place is free again.
    assert PoseDetectorStub(channel).Detect(QUICK, timeout=60).results
    assert [first.result().width, second.result().width] == [5000] * 2


def test_a_call_without_a_message(narrow: Any, channel: grpc.Channel) -> None:
    with pytest.raises(grpc.RpcError, match="expected one message") as caught:
        channel.stream_unary(DETECT)(iter(()), timeout=30)
    assert caught.value.code() is grpc.StatusCode.INVALID_ARGUMENT
    assert PoseDetectorStub(channel).Detect(QUICK, timeout=30).results


def test_calls_follow_a_stream_that_held_the_only_slot(
    narrow: Any, channel: grpc.Channel, slow: pb.DetectRequest
) -> None:
    stub = PoseDetectorStub(channel)
    stream = stub.DetectStream(iter([slow, slow]), timeout=60)
    while not _metric(narrow, "curio_working"):
        assert stream.is_active()
    calls = [stub.Detect.future(QUICK, timeout=60) for _ in range(2)]
    assert [call.result().width for call in calls] == [96, 96]
    assert [answer.width for answer in stream] == [5000, 5000]
    assert _metric(narrow, "curio_working") == _metric(narrow, "curio_queue_length") == 0


def _ask_until_refused(channel: grpc.Channel, held: Sequence[grpc.Future]) -> None:
    """Raise the refusal of the call that is one too many, which may be one of those that are to be held."""
    while True:
        for call in held:
            if call.done():
                call.result()
        PoseDetectorStub(channel).Detect(QUICK, timeout=30)


def test_no_more_open_calls_than_allowed(start_server: Callable[..., Any], models_dir: Any) -> None:
    server, over = start_server(models_dir, "--max-calls", "3"), threading.Event()

    def never() -> Iterator[bytes]:
        over.wait(60)
        yield from ()

    with grpc.insecure_channel(server.address) as channel:
        held = [channel.stream_unary(DETECT).future(never(), timeout=60) for _ in range(3)]
        with pytest.raises(grpc.RpcError, match="Concurrent RPC limit exceeded") as caught:
            _ask_until_refused(channel, held)
        assert caught.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
        for call in held:
            call.cancel()
        over.set()


def test_the_grace_time_ends_before_the_work(
    start_server: Callable[..., Any], models_dir: Any, slow: pb.DetectRequest
) -> None:
    server = start_server(models_dir, "--workers", "2", "--grace-s", "0", "--metrics-port", "0")
    with grpc.insecure_channel(server.address) as channel:
        calls = [PoseDetectorStub(channel).Detect.future(slow, timeout=60) for _ in range(6)]
        while _metric(server, "curio_queue_length") < 4:
            assert server.process.poll() is None
        assert server.stop() == 0
        ends = {error.code() if (error := call.exception()) else grpc.StatusCode.OK for call in calls}
    assert ends <= {grpc.StatusCode.OK, grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.CANCELLED}
    assert ends != {grpc.StatusCode.OK}
