"""Other servers around the same frame work, each in an environment of its own, started and ended here."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
import uuid
import venv
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import grpc
import numpy as np
from curio_proto.inference.inference_pb2 import ModelInferRequest

from load.generator import HEIGHT, MODEL, WIDTH, K, Target, pose_target

_PROGRAMS = Path(__file__).parents[1] / "peers"
_MESSAGES = Path(__file__).parents[2] / "proto"
_REDUCTION = 4
_START_LIMIT_S = 120.0
_MARK = "CURIO_BENCHMARK_PEER"


@dataclass(frozen=True)
class Peer:
    """One of the other servers.

    Attributes:
        name: As the figures call it; its program is ``peers/<name>_server.py``.
        package: Whose version is recorded.
        requirements: What pip installs into its environment.
        environment: Variables that it needs.
    """

    name: str
    package: str
    requirements: tuple[str, ...]
    environment: tuple[tuple[str, str], ...] = ()

    def target(self, address: str, frames: list[bytes]) -> Target:
        """Its calls with these frames."""
        if self.name == "ray":
            return pose_target(address, frames)
        requests = []
        for frame in frames:
            request = ModelInferRequest(model_name=MODEL)
            request.inputs.add(name="image", datatype="BYTES", shape=[1, 1])
            request.raw_input_contents.append(len(frame).to_bytes(4, "little") + frame)
            requests.append(request.SerializeToString())
        return Target(address, "/inference.GRPCInferenceService/ModelInfer", requests)


def all_peers() -> list[Peer]:
    """Those that install from PyPI and serve over gRPC, with the runtime of this environment."""
    runtime = f"onnxruntime=={version('onnxruntime')}"
    opencv = f"opencv-python-headless=={version('opencv-python-headless')}"
    return [
        Peer("ray", "ray", ("ray[serve]==2.60.0", runtime, opencv)),
        # It needs numpy 1, hence OpenCV 4. Its tensor store cannot start under a CPython newer than its own 3.11.
        Peer(
            "pytriton",
            "nvidia-pytriton",
            ("nvidia-pytriton==0.7.0", runtime, "opencv-python-headless<5"),
            (("PYTRITON_NO_TENSORSTORE", "1"),),
        ),
    ]


def prepare(peer: Peer) -> Path:
    """Python of the peer's environment, made below the user's cache folder where it is not there yet."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = cache / "curio-pose" / "peers" / peer.name
    ready, wanted = folder / "requirements.json", json.dumps(peer.requirements)
    if not ready.is_file() or ready.read_text() != wanted:
        print(f"peers: installing {' '.join(peer.requirements)} into {folder}", file=sys.stderr)
        venv.create(folder, with_pip=True, clear=True)
        subprocess.run([folder / "bin/pip", "install", "--quiet", *peer.requirements], check=True, stdout=sys.stderr)
        ready.write_text(wanted)
    return folder / "bin/python"


def installed_version(python: Path, package: str) -> str:
    """Version of a package in that environment."""
    program = f"from importlib.metadata import version; print(version({package!r}))"
    return subprocess.run([python, "-c", program], check=True, capture_output=True, text=True).stdout.strip()


@contextmanager
def running_peer(peer: Peer, python: Path, model: Path, frames: list[bytes], num_workers: int) -> Iterator[Target]:
    """The peer's server once it answers; with all its processes gone after."""
    mark, port = uuid.uuid4().hex, _free_port()
    view_from_reduced = _homography().ravel().tolist()
    program = [python, _PROGRAMS / f"{peer.name}_server.py", model, port, num_workers, *view_from_reduced]
    # As our own processes are: nothing is reported about models.
    environment = {**os.environ, "ORT_DISABLE_TELEMETRY": "1", **dict(peer.environment)}
    environment |= {_MARK: mark, "PYTHONPATH": str(_MESSAGES)}
    log = sys.stderr if os.environ.get("CURIO_PEER_LOG") else subprocess.DEVNULL
    process = subprocess.Popen(list(map(str, program)), env=environment, stdout=log, stderr=log)
    try:
        target = peer.target(f"127.0.0.1:{port}", frames)
        _wait_for_answer(peer, process, target)
        yield Target(target.address, target.method, target.requests, tuple(_marked(mark)))
    finally:
        process.terminate()
        try:
            process.wait(timeout=30)
        except subprocess.TimeoutExpired:
            process.kill()
        for pid in _marked(mark):  # what it left behind
            os.kill(pid, signal.SIGKILL)


def _wait_for_answer(peer: Peer, process: "subprocess.Popen[bytes]", target: Target) -> None:
    end = time.monotonic() + _START_LIMIT_S
    with grpc.insecure_channel(target.address) as channel:
        while True:
            try:
                channel.unary_unary(target.method)(target.requests[0], timeout=10)
                return
            except grpc.RpcError as exc:
                if process.poll() is not None or time.monotonic() > end:
                    raise RuntimeError(
                        f"{peer.name} did not come to serve ({exc.details()}); CURIO_PEER_LOG=1 shows what it says"
                    ) from exc
            time.sleep(0.5)


def _marked(mark: str) -> list[int]:
    """Processes that were started with the mark in their environment, however far down."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if f"{_MARK}={mark}".encode() in (folder / "environ").read_bytes():
                found.append(int(folder.name))
        except OSError:
            continue
    return found


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _homography() -> np.ndarray:
    """From the reduced frame's pixels to those of the network, whose image shows the frame's whole width."""
    scale = 128 * _REDUCTION / WIDTH
    middle = (128 - 1) / 2
    offsets: Sequence[float] = (
        middle - scale * ((K[0, 2] + 0.5) / _REDUCTION - 0.5),
        middle - scale * ((K[1, 2] + 0.5) / _REDUCTION - 0.5),
    )
    assert HEIGHT % _REDUCTION == 0
    return np.array([[scale, 0, offsets[0]], [0, scale, offsets[1]], [0, 0, 1]])
