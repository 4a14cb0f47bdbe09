"""The server's life: starting, refusing to start, load, replacement, leaving; and who may call."""

import itertools
import shutil
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import grpc
import numpy as np
import onnx
import pytest
from curio_proto.v1 import detector_pb2 as pb
from curio_proto.v1.detector_pb2_grpc import PoseDetectorStub
from curio_serve.client import PoseClient
from curio_serve.errors import Unavailable
from curio_serve.server.server import _warn_of_little_memory
from google.rpc import error_details_pb2
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_status import rpc_status

StartServer = Callable[..., Any]
SMALL = pb.RawImage(format=pb.PIXEL_FORMAT_GRAY8, width=96, height=64, data=bytes(96 * 64))
SMALL_REQUEST = pb.DetectRequest(models=[pb.ModelSelector(name="flat")], raw=SMALL)


@pytest.fixture(scope="module")
def slow_request() -> pb.DetectRequest:
    """A frame that takes long to decode: 25 million pixels in a small file."""
    data = cv2.imencode(".png", np.zeros((5000, 5000), np.uint8))[1].tobytes()
    return pb.DetectRequest(models=[pb.ModelSelector(name="flat")], encoded=data)


def _run(*arguments: str) -> "subprocess.CompletedProcess[str]":
    code = "from curio_serve.server.serve_cli import main; main()"
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=60, check=False
    )


def _metric(url: str, name: str) -> float:
    with urllib.request.urlopen(url, timeout=10) as page:
        lines = [line.split() for line in page.read().decode().splitlines()]
    return next(float(line[1]) for line in lines if line[0] == name)


def test_a_taken_port_is_named(server: Any, models_dir: Path) -> None:
    port = server.address.rsplit(":", 1)[1]
    ended = _run(str(models_dir), "--port", port)
    assert ended.returncode == 1
    assert f"cannot listen on 127.0.0.1:{port}: Address already in use; choose another --host or --port" in ended.stderr
    assert "Traceback" not in ended.stderr


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["{tmp}/nowhere"], 1, "models folder {tmp}/nowhere cannot be read"),
        (["{tmp}/run"], 1, "it is a run of curio-train; give its models, {tmp}/run/models"),
        (["{tmp}"], 1, "no model could be loaded from {tmp}: it holds no <name>/<version>/model.onnx"),
        (["{models}/flat"], 1, "it is the folder of one model; give the folder that holds it, {models}"),
        (["{models}", "--token-file", "{tmp}/none"], 2, "--token-file {tmp}/none cannot be read"),
        (["{models}", "--tls-key", "{tmp}/k", "--tls-certificate", "{tmp}/c"], 2, "--tls-key {tmp}/k cannot be read"),
        (["{models}", "--tls-key", "{readme}", "--tls-certificate", "{readme}"], 2, "expected PEM files"),
        (["{models}", "--host", "203.0.113.7"], 1, "cannot listen on 203.0.113.7:0: Cannot assign requested address"),
        (["{models}", "--provider", "nosuch"], 2, "has no provider 'nosuch'; it has cpu (CPUExecutionProvider)"),
        (["{models}", "--queue", "-3"], 2, "--queue is -3"),
    ],
)
def test_what_cannot_start_says_why(
    arguments: list[str], status: int, words: str, models_dir: Path, tmp_path: Path
) -> None:
    (tmp_path / "run" / "models").mkdir(parents=True)
    names = {"tmp": str(tmp_path), "models": str(models_dir), "readme": __file__}
    ended = _run(*[argument.format(**names) for argument in arguments], "--port", "0")
    assert ended.returncode == status
    assert words.format(**names) in ended.stderr
    assert "Traceback" not in ended.stderr


def test_dump_config(models_dir: Path) -> None:
    ended = _run(str(models_dir), "--queue", "7", "--dump-config")
    assert ended.returncode == 0
    assert "queue = 7\n" in ended.stdout


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_end_an_idle_server(start_server: StartServer, models_dir: Path, number: int) -> None:
    server = start_server(models_dir)
    assert server.stop(number) == 0
    assert "Traceback" not in server.log.read_text()


def test_accepted_requests_are_finished_before_it_leaves(
    start_server: StartServer, models_dir: Path, slow_request: pb.DetectRequest
) -> None:
    server = start_server(models_dir, "--workers", "1", "--metrics-port", "0")
    with grpc.insecure_channel(server.address) as channel:
        stub = PoseDetectorStub(channel)
        calls = [stub.Detect.future(slow_request, timeout=60) for _ in range(4)]
        while _metric(server.metrics_url, "curio_queue_length") < 3:
            assert server.process.poll() is None
        assert server.stop() == 0
        assert [call.result().width for call in calls] == [5000] * 4
        with pytest.raises(grpc.RpcError) as caught:
            stub.Detect(SMALL_REQUEST, timeout=10)
        assert caught.value.code() is grpc.StatusCode.UNAVAILABLE


def test_a_stream_that_waits_for_a_frame_does_not_hold_up_a_server_that_stops(
    start_server: StartServer, models_dir: Path
) -> None:
    server, over = start_server(models_dir, "--grace-s", "600"), threading.Event()

    def one_frame() -> Iterator[pb.DetectRequest]:
        yield SMALL_REQUEST
        over.wait(60)

    with grpc.insecure_channel(server.address) as channel:
        answers = PoseDetectorStub(channel).DetectStream(one_frame(), timeout=60)
        assert next(answers).width
        assert server.stop() == 0
        with pytest.raises(grpc.RpcError):
            next(answers)
        over.set()


def test_a_stream_without_end_is_ended_after_a_frame_and_told_why(start_server: StartServer, models_dir: Path) -> None:
    server = start_server(models_dir, "--grace-s", "4")
    with PoseClient(server.address) as client:
        answers = client.detect_stream(itertools.repeat(SMALL_REQUEST), timeout_s=60)
        assert next(answers).width
        server.process.send_signal(signal.SIGTERM)
        with pytest.raises(Unavailable, match="the server stops; open the stream again"):
            list(answers)
    assert server.process.wait(30) == 0


def test_a_server_that_loses_all_models_is_not_ready(
    start_server: StartServer, models_dir: Path, tmp_path: Path
) -> None:
    models = Path(shutil.copytree(models_dir, tmp_path / "models"))
    server = start_server(models, "--refresh-s", "0.1")
    with grpc.insecure_channel(server.address) as channel:
        health = health_pb2_grpc.HealthStub(channel)

        def wait_for(status: str) -> None:
            wanted, end = health_pb2.HealthCheckResponse.ServingStatus.Value(status), time.monotonic() + 60
            while health.Check(health_pb2.HealthCheckRequest()).status != wanted:
                assert time.monotonic() < end, f"not {status}"
                time.sleep(0.05)

        wait_for("SERVING")
        for name in ("flat", "pinhole"):
            shutil.rmtree(models / name)
        wait_for("NOT_SERVING")
        shutil.copytree(models_dir / "flat", models / "flat")
        wait_for("SERVING")


def test_a_full_queue_is_told_with_the_time_to_come_back(
    start_server: StartServer, models_dir: Path, slow_request: pb.DetectRequest
) -> None:
    server = start_server(models_dir, "--workers", "1", "--queue", "1")
    refused = 0
    with grpc.insecure_channel(server.address) as channel:
        stub = PoseDetectorStub(channel)
        calls = [stub.Detect.future(slow_request, timeout=60) for _ in range(8)]
        for call in calls:
            error = call.exception()
            if error is None:
                continue
            refused += 1
            assert error.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
            retry = error_details_pb2.RetryInfo()
            assert any(detail.Unpack(retry) for detail in rpc_status.from_call(error).details)
            assert retry.retry_delay.ToNanoseconds() > 0
        assert 1 <= refused <= 6
        assert stub.Detect(SMALL_REQUEST, timeout=30).results


def test_models_are_replaced_without_a_failed_call(
    start_server: StartServer, models_dir: Path, tmp_path: Path, spot_onnx: Callable[..., onnx.ModelProto],
    write_folder: Callable[..., Path],
) -> None:  # fmt: skip
    root = Path(shutil.copytree(models_dir, tmp_path / "models"))
    server = start_server(root, "--refresh-s", "0.05")
    seen: set[int] = set()
    done = threading.Event()

    def ask() -> int:
        num_calls = 0
        with grpc.insecure_channel(server.address) as channel:
            stub = PoseDetectorStub(channel)
            while not done.is_set():
                seen.add(stub.Detect(SMALL_REQUEST, timeout=30).results[0].model_version)
                num_calls += 1
        return num_calls

    with ThreadPoolExecutor(2) as pool:
        asking = [pool.submit(ask) for _ in range(2)]
        try:
            for version in range(2, 4):
                write_folder(root / "flat", spot_onnx(False), version)
                while version not in seen and not any(call.done() for call in asking):
                    done.wait(0.01)
            (root / "flat" / "9").mkdir()
            (root / "flat" / "9" / "model.onnx").write_bytes(b"broken")
            while "is not an ONNX file" not in server.log.read_text() and not any(call.done() for call in asking):
                done.wait(0.01)
        finally:
            done.set()
        assert all(call.result() > 0 for call in asking)
    assert {2, 3} <= seen
    assert 9 not in seen


def test_tokens(start_server: StartServer, models_dir: Path, tmp_path: Path) -> None:
    tokens = tmp_path / "tokens"
    tokens.write_text("first-token\n\nsecond-token\n")
    server = start_server(models_dir, "--token-file", str(tokens), "--log-level", "debug", "--metrics-port", "0")
    with grpc.insecure_channel(server.address) as channel:
        stub = PoseDetectorStub(channel)
        for good in ("first-token", "second-token"):
            metadata = [("authorization", f"Bearer {good}")]
            assert stub.Detect(SMALL_REQUEST, timeout=10, metadata=metadata).results
        for bad in ("Bearer wrong-token", "first-token", "Bearer ", "Bearer first-token ", "Basic first-token"):
            with pytest.raises(grpc.RpcError) as caught:
                stub.Detect(SMALL_REQUEST, timeout=10, metadata=[("authorization", bad)])
            assert caught.value.code() is grpc.StatusCode.UNAUTHENTICATED
        with pytest.raises(grpc.RpcError) as caught:
            list(stub.DetectStream(iter([SMALL_REQUEST]), timeout=10))
        assert caught.value.code() is grpc.StatusCode.UNAUTHENTICATED
        answer = health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest(), timeout=10)
        assert answer.status == health_pb2.HealthCheckResponse.SERVING
    # The scrape shows every refusal, the log where it came from; neither shows a token.
    assert _metric(server.metrics_url, 'curio_requests_total{code="UNAUTHENTICATED",method="any"}') == 6
    assert server.stop() == 0
    log = server.log.read_text()
    assert log.count("bearer token missing or unknown") == 6
    assert '"peer": "ipv4:127.0.0.1:' in log
    assert not any(token in log for token in ("first-token", "second-token", "wrong-token"))


class Authority:
    """A certificate authority of our own, made with the openssl command."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._openssl("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "2",
                      "-keyout", "ca.key", "-out", "ca.pem", "-subj", "/CN=test authority")  # fmt: skip

    def _openssl(self, *arguments: str) -> None:
        subprocess.run(["openssl", *arguments], cwd=self.folder, check=True, capture_output=True, timeout=60)

    def issue(self, name: str) -> tuple[Path, Path]:
        """Certificate and key for 127.0.0.1."""
        (self.folder / "ext").write_text("subjectAltName=IP:127.0.0.1")
        self._openssl("req", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes",
                      "-keyout", f"{name}.key", "-out", f"{name}.csr", "-subj", f"/CN={name}")  # fmt: skip
        self._openssl("x509", "-req", "-in", f"{name}.csr", "-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial",
                      "-days", "2", "-extfile", "ext", "-out", f"{name}.pem")  # fmt: skip
        return self.folder / f"{name}.pem", self.folder / f"{name}.key"


@pytest.fixture(scope="module")
def authorities(tmp_path_factory: pytest.TempPathFactory) -> tuple[Authority, Authority]:
    if shutil.which("openssl") is None:
        pytest.skip("the openssl command is not installed; it makes the certificates of this test")
    return Authority(tmp_path_factory.mktemp("ours")), Authority(tmp_path_factory.mktemp("theirs"))


def test_tls_and_client_certificates(
    start_server: StartServer, models_dir: Path, authorities: tuple[Authority, Authority]
) -> None:
    ours, theirs = authorities
    certificate, key = ours.issue("server")
    roots = (ours.folder / "ca.pem").read_bytes()
    good, bad = ours.issue("client"), theirs.issue("stranger")
    server = start_server(models_dir, "--tls-certificate", str(certificate), "--tls-key", str(key),
                          "--client-ca", str(ours.folder / "ca.pem"))  # fmt: skip

    def status(root: bytes, pair: tuple[Path, Path] | None) -> grpc.StatusCode:
        shown = (pair[1].read_bytes(), pair[0].read_bytes()) if pair else (None, None)
        with grpc.secure_channel(server.address, grpc.ssl_channel_credentials(root, *shown)) as channel:
            try:
                PoseDetectorStub(channel).Detect(SMALL_REQUEST, timeout=10)
            except grpc.RpcError as exc:
                return exc.code()
        return grpc.StatusCode.OK

    assert status(roots, good) is grpc.StatusCode.OK
    assert status(roots, None) is grpc.StatusCode.UNAVAILABLE
    assert status(roots, bad) is grpc.StatusCode.UNAVAILABLE
    assert status((theirs.folder / "ca.pem").read_bytes(), good) is grpc.StatusCode.UNAVAILABLE
    with grpc.insecure_channel(server.address) as channel, pytest.raises(grpc.RpcError):
        PoseDetectorStub(channel).Detect(SMALL_REQUEST, timeout=10)


def test_it_serves_where_the_training_stack_cannot_be_imported(models_dir: Path) -> None:
    code = """
import sys
for name in ("torch", "mitsuba", "drjit", "onnx", "trimesh", "curio_train"):
    sys.modules[name] = None
from curio_serve.server.config import ServeConfig
from curio_serve.server.server import PoseServer
from pathlib import Path

server = PoseServer(ServeConfig(models=Path(sys.argv[1]), port=0))
print(server.start())
server.stop()
server.serve_until_stopped()
"""
    ended = subprocess.run(
        [sys.executable, "-c", code, str(models_dir)], capture_output=True, text=True, timeout=60, check=False
    )
    assert ended.returncode == 0, ended.stderr
    assert "127.0.0.1:" in ended.stdout


def test_a_server_whose_models_leave_little_memory_says_so(caplog: pytest.LogCaptureFixture) -> None:
    for used, most in ((700 << 20, None), (500 << 20, 1 << 30), (700 << 20, 1 << 30)):
        _warn_of_little_memory(used, most)
    (record,) = caplog.records
    assert "models leave little memory" in record.getMessage()
    assert vars(record)["values"] == {"used_mb": 700, "limit_mb": 1024}
