"""Clients that misbehave on the wire: the server goes on answering the others."""

import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import grpc
import pytest
from curio_proto.v1 import detector_pb2 as pb
from curio_proto.v1.detector_pb2_grpc import PoseDetectorStub

SMALL = pb.RawImage(format=pb.PIXEL_FORMAT_GRAY8, width=96, height=64, data=bytes(96 * 64))
FLAT = pb.ModelSelector(name="flat")
REQUEST = pb.DetectRequest(models=[FLAT], raw=SMALL)


def _answers(address: str) -> None:
    with grpc.insecure_channel(address, options=[("grpc.use_local_subchannel_pool", 1)]) as channel:
        answer = PoseDetectorStub(channel).Detect(REQUEST, timeout=30)
    assert answer.results[0].model == "flat"


@pytest.mark.parametrize(
    "opening", [b"", b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", b"GET / HTTP/1.1\r\n\r\n", os.urandom(300)],
    ids=["silence", "preface", "http1", "noise"],
)  # fmt: skip
def test_connections_opened_and_dropped(server: Any, opening: bytes) -> None:
    host, port = server.address.rsplit(":", 1)
    for _ in range(250):
        with socket.create_connection((host, int(port)), timeout=10) as connection:
            connection.sendall(opening)
    _answers(server.address)


def test_many_connections_held_open(server: Any) -> None:
    host, port = server.address.rsplit(":", 1)
    held = [socket.create_connection((host, int(port)), timeout=10) for _ in range(250)]
    try:
        _answers(server.address)
    finally:
        for connection in held:
            connection.close()


def test_calls_that_never_send_their_message(server: Any) -> None:
    over = threading.Event()

    def nothing() -> Iterator[pb.DetectRequest]:
        over.wait(60)
        yield from ()

    with grpc.insecure_channel(server.address) as channel:
        calls = [PoseDetectorStub(channel).DetectStream(nothing()) for _ in range(60)]
        _answers(server.address)
        for call in calls:
            call.cancel()
        over.set()
    _answers(server.address)


def test_more_streams_than_allowed(start_server: Callable[..., Any], models_dir: Path) -> None:
    server = start_server(models_dir, "--max-streams", "2")
    over = threading.Event()

    def one() -> Iterator[pb.DetectRequest]:
        yield REQUEST
        over.wait(60)

    with grpc.insecure_channel(server.address) as channel:
        stub = PoseDetectorStub(channel)
        streams = [stub.DetectStream(one()) for _ in range(2)]
        assert all(next(stream).results for stream in streams)
        with pytest.raises(grpc.RpcError, match="2 streams are open") as caught:
            next(stub.DetectStream(one(), timeout=30))
        assert caught.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
        over.set()
        assert [list(stream) for stream in streams] == [[], []]
        assert next(stub.DetectStream(iter([REQUEST]), timeout=30)).results


def test_a_reader_that_does_not_read(server: Any) -> None:
    large = pb.DetectRequest(models=[FLAT] * 16, raw=SMALL, regions=[pb.Region(width=96, height=64)] * 64)
    with grpc.insecure_channel(server.address) as channel:
        stream = PoseDetectorStub(channel).DetectStream(iter([large] * 40))
        assert len(next(stream).results) == 16 * 64
        for _ in range(20):
            _answers(server.address)
        stream.cancel()
    _answers(server.address)


@pytest.mark.parametrize(
    "method", ["curio.v1.PoseDetector/Detect", "curio.v1.PoseDetector/DetectStream", "grpc.health.v1.Health/Check",
               "inference.GRPCInferenceService/ModelInfer"],
)  # fmt: skip
def test_messages_nobody_can_read_keep_no_call_open(server: Any, method: str) -> None:
    """More of them than a connection may have streams; the same connection still works after."""
    with grpc.insecure_channel(server.address) as channel:
        for _ in range(600):
            with pytest.raises(grpc.RpcError, match="cannot be read as") as caught:
                next(channel.stream_stream(f"/{method}")(iter([b"\xff" * 50]), timeout=30))
            assert caught.value.code() is grpc.StatusCode.INVALID_ARGUMENT
        assert PoseDetectorStub(channel).Detect(REQUEST, timeout=30).results


def test_a_log_that_cannot_be_written(models_dir: Path) -> None:
    code = "from curio_serve.server.serve_cli import main; main()"
    command = [sys.executable, "-c", code, str(models_dir), "--port", "0", "--log-level", "debug"]
    with Path("/dev/full").open("w") as full:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=full, text=True)
    with process:
        assert process.stdout is not None
        address = process.stdout.readline().split()[-1]
        for _ in range(10):
            _answers(address)
        process.terminate()
        assert process.wait(timeout=60) == 0
