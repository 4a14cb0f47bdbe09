"""Attacks on a real server: memory, work and places are bounded, and it can always be ended."""

import contextlib
import fcntl
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import grpc
import pytest
from curio_proto.v1 import detector_pb2 as pb
from curio_proto.v1.detector_pb2_grpc import PoseDetectorStub
from curio_serve.client import PoseClient
from curio_serve.errors import Overloaded, UsageError
from curio_serve.server import metrics_port
from curio_serve.server.config import read_config
from curio_serve.server.security import read_tokens, server_credentials
from load.attacks import opening
from prometheus_client import CollectorRegistry

DETECT = "/curio.v1.PoseDetector/Detect"
FLAT = pb.ModelSelector(name="flat")
SMALL = pb.RawImage(format=pb.PIXEL_FORMAT_GRAY8, width=96, height=64, data=bytes(96 * 64))
REQUEST = pb.DetectRequest(models=[FLAT], raw=SMALL)
StartServer = Callable[..., Any]


@pytest.fixture
def never() -> Iterator[Callable[[], Iterator[bytes]]]:
    """Messages that do not come until the test is over."""
    over = threading.Event()

    def messages() -> Iterator[bytes]:
        over.wait(60)
        yield from ()

    yield messages
    over.set()


def _peak_mb(pid: int) -> int:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) // 1024


@pytest.mark.parametrize(
    ("path", "element"),
    [(DETECT, b"\x12\x00"), ("/inference.GRPCInferenceService/ModelInfer", b"\x2a\x00")],
    ids=["models", "inputs"],
)
def test_millions_of_empty_elements(server: Any, path: str, element: bytes) -> None:
    """They are 30 MB on the wire and were gigabytes in memory."""
    before = _peak_mb(server.process.pid)
    with grpc.insecure_channel(server.address) as channel:
        with pytest.raises(grpc.RpcError, match="more than 4096 fields") as caught:
            channel.unary_unary(path)(element * (15 << 20), timeout=60)
        assert caught.value.code() is grpc.StatusCode.INVALID_ARGUMENT
        assert PoseDetectorStub(channel).Detect(REQUEST, timeout=30).results
    assert _peak_mb(server.process.pid) - before < 200


def test_messages_and_streams_that_do_not_come(
    start_server: StartServer, models_dir: Path, never: Callable[[], Iterator[bytes]]
) -> None:
    server = start_server(models_dir, "--message-s", "0.5", "--idle-s", "0.5")

    def one() -> Iterator[pb.DetectRequest]:
        yield REQUEST
        yield from never()

    with grpc.insecure_channel(server.address) as channel:
        hanging = [channel.stream_unary(path).future(never()) for path in (DETECT, "/grpc.health.v1.Health/Check")]
        stream = PoseDetectorStub(channel).DetectStream(one())
        assert next(stream).results
        assert all(call.exception(timeout=30).code() is grpc.StatusCode.CANCELLED for call in hanging)
        with pytest.raises(grpc.RpcError) as caught:
            next(stream)
        assert caught.value.code() is grpc.StatusCode.CANCELLED
        assert PoseDetectorStub(channel).Detect(REQUEST, timeout=30).results


def test_messages_that_do_not_come_leave_memory_to_others(
    start_server: StartServer, models_dir: Path, never: Callable[[], Iterator[bytes]]
) -> None:
    server = start_server(models_dir, "--max-message-mb", "4", "--message-memory-mb", "8")
    with grpc.insecure_channel(server.address) as greedy, grpc.insecure_channel(server.address) as other:
        hanging = [greedy.stream_unary(DETECT).future(never()) for _ in range(8)]  # there is room for two
        for _ in range(2):
            assert PoseDetectorStub(other).Detect(REQUEST, timeout=30, wait_for_ready=True).results
        for call in hanging:
            call.cancel()


def test_a_connection_has_a_part_of_the_streams(
    start_server: StartServer, models_dir: Path, never: Callable[[], Iterator[bytes]]
) -> None:
    server = start_server(models_dir, "--max-streams", "12")

    def one() -> Iterator[pb.DetectRequest]:
        yield REQUEST
        yield from never()

    options = [("grpc.use_local_subchannel_pool", 1)]
    with (
        grpc.insecure_channel(server.address, options=options) as greedy,
        grpc.insecure_channel(server.address, options=options) as other,
    ):
        streams = [PoseDetectorStub(greedy).DetectStream(one()) for _ in range(8)]
        assert all(next(stream).results for stream in streams)
        with pytest.raises(grpc.RpcError, match="8 streams of this connection are open") as caught:
            next(PoseDetectorStub(greedy).DetectStream(one(), timeout=30))
        assert caught.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
        assert next(PoseDetectorStub(other).DetectStream(iter([REQUEST]), timeout=30)).results
        for stream in streams:
            stream.cancel()


def test_idle_streams_do_not_keep_others_out(
    start_server: StartServer, models_dir: Path, never: Callable[[], Iterator[bytes]]
) -> None:
    server = start_server(models_dir, "--max-streams", "8")

    def one() -> Iterator[pb.DetectRequest]:
        yield REQUEST
        yield from never()

    options = [("grpc.use_local_subchannel_pool", 1)]
    with (
        grpc.insecure_channel(server.address, options=options) as greedy,
        PoseClient(server.address, timeout_s=30) as other,
    ):
        idle = [PoseDetectorStub(greedy).DetectStream(one()) for _ in range(8)]
        assert all(next(stream).results for stream in idle)
        answers: list[pb.DetectResponse] = []
        end = time.monotonic() + 30
        while not answers and time.monotonic() < end:
            with contextlib.suppress(Overloaded):  # until one of them counts as idle
                answers = list(other.detect_stream([REQUEST], timeout_s=30))
        assert answers[0].results
        assert sum(call.is_active() for call in idle) >= 7
        for call in idle:
            call.cancel()


def test_models_times_regions_are_bounded(server: Any) -> None:
    regions = [pb.Region(width=96, height=64)] * 64
    request = pb.DetectRequest(models=[FLAT, pb.ModelSelector(name="pinhole")], raw=SMALL, regions=regions)
    with grpc.insecure_channel(server.address) as channel:
        with pytest.raises(grpc.RpcError, match="2 models times 64 regions are 128 runs"):
            PoseDetectorStub(channel).Detect(request, timeout=30)
        same = pb.DetectRequest(models=[FLAT, pb.ModelSelector(name="flat", version=1)], raw=SMALL)
        with pytest.raises(grpc.RpcError, match="names a model more than once"):
            PoseDetectorStub(channel).Detect(same, timeout=30)


def test_texts_beyond_ascii_fit_into_the_trailers(server: Any) -> None:
    request = pb.DetectRequest(models=[pb.ModelSelector(name="\U0001f42b" * 60)], raw=SMALL, request_id="\u0416" * 90)
    with grpc.insecure_channel(server.address) as channel:
        with pytest.raises(grpc.RpcError, match="no model") as caught:
            PoseDetectorStub(channel).Detect(request, timeout=30)
        assert caught.value.code() is grpc.StatusCode.NOT_FOUND


@pytest.fixture
def tls(tmp_path: Path) -> list[str]:
    """Flags that name files without a certificate or a key in them."""
    for name in ("certificate", "key"):
        (tmp_path / name).touch()
    return ["--tls-certificate", str(tmp_path / "certificate"), "--tls-key", str(tmp_path / "key")]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--workers", "100000"], "--workers is 100000; expected at most 1024"),
        (["--host", ""], "--host is empty"),
        (["--client-ca", "/dev/zero"], "--client-ca /dev/zero cannot be read: more than 4194304 bytes"),
        (["--config", "/dev/zero"], "--config /dev/zero cannot be read: more than 4194304 bytes"),
    ],
)
def test_wrong_settings_are_named(models_dir: Path, tls: list[str], arguments: list[str], words: str) -> None:
    command = _command(models_dir, *tls, *arguments)
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 2
    assert words in ended.stderr


def test_files_that_cannot_be_used_are_named(models_dir: Path, tls: list[str]) -> None:
    """In this process: a server loads its models before it opens these files, which takes two seconds each time."""
    for path in (__file__, "/dev/null"):
        config = read_config([str(models_dir), *tls, "--client-ca", path], {})
        with pytest.raises(UsageError, match=f"--client-ca {path} cannot be used; expected a PEM file") as caught:
            server_credentials(config)
        assert caught.value.exit_status == 2
    with pytest.raises(UsageError, match="--token-file /dev/zero cannot be read: more than 4194304 bytes"):
        read_tokens(Path("/dev/zero"))


def _command(models_dir: Path, *flags: str) -> list[str]:
    code = "from curio_serve.server.serve_cli import main; main()"
    return [sys.executable, "-c", code, str(models_dir), "--port", "0", *flags]


def test_it_ends_while_nobody_reads_its_log(models_dir: Path) -> None:
    """More lines than a pipe holds, and then SIGTERM."""
    reader, writer = os.pipe()
    fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, 4096)  # instead of 64 kB, which a thousand calls fill
    command = _command(models_dir, "--log-level", "debug")
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=writer, text=True) as process:
        os.close(writer)
        assert process.stdout is not None
        with grpc.insecure_channel(process.stdout.readline().split()[-1]) as channel:
            for _ in range(100):
                PoseDetectorStub(channel).Detect(REQUEST, timeout=30)
        process.terminate()
        assert process.wait(timeout=30) == 0
    os.close(reader)


def test_it_serves_and_ends_while_its_stdout_is_full(models_dir: Path, tmp_path: Path) -> None:
    log = tmp_path / "log"
    with Path("/dev/full").open("w") as full, log.open("w") as stderr:
        process = subprocess.Popen(_command(models_dir), stdout=full, stderr=stderr, text=True)
    while "stdout cannot be written" not in log.read_text():
        assert process.poll() is None
    process.terminate()
    assert process.wait(timeout=30) == 0
    assert "Traceback" not in log.read_text()


def test_the_metrics_port_answers_one_path_within_a_limit(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(metrics_port, "_LIMIT_S", 0.3)
    http = metrics_port.MetricsPort("127.0.0.1", 0, CollectorRegistry())
    http.start()
    address = ("127.0.0.1", http.server_port)
    silent = socket.create_connection(address)
    for beginning in (b"GET /metrics HTTP/1.1\r\n\r\n", b"\xff\xfe\r\n\r\n", b""):
        with socket.create_connection(address) as broken_off:
            broken_off.sendall(beginning)
            broken_off.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    with urllib.request.urlopen(f"http://127.0.0.1:{http.server_port}/metrics", timeout=30) as answer:
        assert answer.status == 200
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(f"http://127.0.0.1:{http.server_port}/other", timeout=30)
    silent.settimeout(30)
    assert silent.recv(1) == b""
    http.shutdown()
    http.server_close()
    assert capfd.readouterr().err == ""


def test_a_header_beyond_utf8_leaves_no_traceback(start_server: StartServer, models_dir: Path) -> None:
    server = start_server(models_dir)
    host, port = server.address.rsplit(":", 1)
    with socket.create_connection((host, int(port)), timeout=30) as connection:
        connection.sendall(opening((b"x-name", b"\xff\xfe")))
        time.sleep(0.5)
    with grpc.insecure_channel(server.address) as channel:
        assert PoseDetectorStub(channel).Detect(REQUEST, timeout=30).results
    assert server.stop() == 0
    assert "Invalid encoding" not in server.log.read_text()


def test_a_hang_up_drains(start_server: StartServer, models_dir: Path) -> None:
    server = start_server(models_dir)
    assert server.stop(signal.SIGHUP) == 0
    assert "draining" in server.log.read_text()
