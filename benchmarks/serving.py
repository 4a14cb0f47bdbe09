"""What serving costs over the bare model, and how it behaves below and beyond its limit.

    python benchmarks/serving.py [--json] [--seconds 6] [--rounds 9] [--peers]

Everything is measured on this machine, over the loopback: 640x480 JPEGs, the paper's network, a real ``curio-serve``
process, and a load generator in a process of its own.

served_over_raw   CPU time a frame of a bare loop (same decode, warp and session; as many threads as the server has
                  workers) over the server process's CPU time a request at concurrency 4; median of alternating rounds
plain_over_raw    the same of grpcio's own threaded server with the bare loop in its handler and nothing else, in the
                  same rounds: what gRPC in Python leaves of the model. The bare loop has both cores and their caches
                  to itself; a server shares them with the load generator, and pays for it in the model's time, too
frame_ms          one frame end to end at concurrency 1, median; ``bare_frame_ms`` of the bare loop in one thread
ready_s           from starting the process until its health service says SERVING, median of three starts
rss_mb            the server's resident memory after that load; ``peak_rss_mb`` its largest
p50_ms, p99_ms    latency at half the saturating rate, frames coming evenly, counted from when a frame was due;
                  ``bare_p50_ms`` and ``bare_p99_ms`` of the bare loop in one thread: what the machine itself does
goodput_at_3x     good answers a second while three times the saturating rate is offered, over those at saturation;
                  ``tight_goodput_at_3x`` where calls have a deadline of 0.1 s instead of 1 s

For these latencies and goodputs the server has one half of the cores and the load generator the other, so that making
load does not pass for the server's weakness. ``offered_over_peak`` says what load was really made.

objects8_frame_ms  CPU time a frame of models/lmo, served with one worker, all of its eight objects;
                   ``objects1_frame_ms`` one asked for by name; ``bare_…`` of the bare loop

With ``--peers``, other servers around the same decoding, warp and session stand beside ours under ``peers``, each with
its version, the CPU time a request of all its processes, the answers a second at concurrency 4 with the load generator
on the same cores, latency at concurrency 1, and the memory of all its processes.
"""

import contextlib
import json
import math
import multiprocessing
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import tyro
from grpc_health.v1 import health_pb2, health_pb2_grpc
from load.generator import (
    MODEL,
    WIDTH,
    K,
    Target,
    bare_cpu_ms,
    bare_latencies_ms,
    closed_loop,
    closed_loop_of,
    cpu_s,
    make_frames,
    open_loop,
    pose_target,
)
from load.network import write_model
from load.peers import all_peers, installed_version, prepare, running_peer

_START_LIMIT_S = 60.0
_WARM_UP_S = 2.0
_TIGHT_DEADLINE_S = 0.1
_SEVERAL = Path("models/lmo")
_ASKED_FOR: dict[str, Sequence[str]] = {"objects8": (), "objects1": ("ape",)}
_SEVERAL_CALLS, _SEVERAL_DEADLINE_S = 100, 60.0  # CPU time is told in steps of 10 ms


@dataclass(frozen=True)
class Arguments:
    """Measure what serving costs over the bare model."""

    json: bool = False
    """Print one JSON object on the last line instead of a table."""
    seconds: float = 6.0
    """Length of each measurement."""
    rounds: int = 9
    """How often bare loop and server are measured in turn, a third as long each: what neighbours on the machine do
    changes within seconds."""
    peers: bool = False
    """Put the same load on other servers too; installs them into the user's cache folder the first time."""


def main() -> None:
    """Measures, prints, and leaves nothing behind."""
    arguments = tyro.cli(Arguments)
    frames = make_frames()
    with tempfile.TemporaryDirectory() as folder:
        models = Path(folder)
        write_model(models / MODEL, K, WIDTH)
        figures = {"ready_s": round(statistics.median(start_time_s(models) for _ in range(3)), 3)}
        figures |= cost(models, frames, arguments)
        figures |= limits(models, frames, arguments.seconds)
        figures |= several_objects(frames, arguments.seconds)
        if arguments.peers:
            figures["peers"] = beside_peers(models, frames, arguments.seconds)
    if arguments.json:
        print(json.dumps(figures))
        return
    for name, value in figures.items():
        print(f"{name:20} {value}")


def cost(models: Path, frames: list[bytes], arguments: Arguments) -> dict[str, Any]:
    """Latency of one caller, CPU time a request beside the bare loop's, memory."""
    cores = sorted(os.sched_getaffinity(0))
    raw_ms, plain_ms, served_ms = [], [], []
    with (
        running_server(models, cores) as (address, pid),
        plain_server(models / MODEL, len(cores)) as (plain_address, plain_pid),
        worker(cores) as load,
        worker(cores) as bare,
    ):
        target, plain = pose_target(address, frames, pid), pose_target(plain_address, frames, plain_pid)
        for warm in (target, plain):
            load(closed_loop, warm, 4, _WARM_UP_S)
        alone = load(closed_loop, target, 1, arguments.seconds)
        bare_alone = bare(bare_latencies_ms, models / MODEL, frames, math.inf, arguments.seconds)
        for _ in range(arguments.rounds):
            raw_ms.append(bare(bare_cpu_ms, models / MODEL, frames, len(cores), arguments.seconds / 3))
            for figures, server in ((served_ms, target), (plain_ms, plain)):
                before_s = sum(map(cpu_s, server.processes))
                served = load(closed_loop, server, 4, arguments.seconds / 3)
                figures.append(1000 * (sum(map(cpu_s, server.processes)) - before_s) / served["codes"]["OK"])
        rss_mb, peak_rss_mb = memory_mb(pid)
    return {
        "served_over_raw": round(float(np.median(np.divide(raw_ms, served_ms))), 3),
        "plain_over_raw": round(float(np.median(np.divide(raw_ms, plain_ms))), 3),
        "raw_cpu_ms": round(statistics.median(raw_ms), 3),
        "plain_cpu_ms": round(statistics.median(plain_ms), 3),
        "served_cpu_ms": round(statistics.median(served_ms), 3),
        "frame_ms": round(statistics.median(alone["latencies_ms"]), 3),
        "bare_frame_ms": round(statistics.median(bare_alone), 3),
        "rss_mb": rss_mb,
        "peak_rss_mb": peak_rss_mb,
    }


def limits(models: Path, frames: list[bytes], seconds: float) -> dict[str, Any]:
    """Latency below saturation, and goodput beyond it."""
    cores = sorted(os.sched_getaffinity(0))
    half = max(1, len(cores) // 2)
    with running_server(models, cores[:half]) as (address, _), worker(cores[half:] or cores) as load:
        target = pose_target(address, frames)
        load(closed_loop, target, 4, _WARM_UP_S)
        peak = max(load(closed_loop, target, c * half, seconds)["goodput"] for c in (2, 8))
        calm = load(open_loop, target, peak / 2, seconds)
        with worker(cores[:half]) as bare:
            bare_calm = bare(bare_latencies_ms, models / MODEL, frames, peak / half / 2, seconds)
        flood = load(open_loop, target, 3 * peak, seconds)
        tight = load(open_loop, target, 3 * peak, seconds, _TIGHT_DEADLINE_S)
    p50_ms, p99_ms = np.percentile(calm["latencies_ms"], (50, 99))
    bare_p50_ms, bare_p99_ms = np.percentile(bare_calm, (50, 99))
    return {
        "p50_ms": round(float(p50_ms), 3),
        "p99_ms": round(float(p99_ms), 3),
        "bare_p50_ms": round(float(bare_p50_ms), 3),
        "bare_p99_ms": round(float(bare_p99_ms), 3),
        "peak_per_s": round(peak, 1),
        "goodput_at_3x": round(flood["goodput"] / peak, 3),
        "tight_goodput_at_3x": round(tight["goodput"] / peak, 3),
        "offered_over_peak": round(flood["offered"] / peak, 2),
        "codes_at_3x": flood["codes"],
        "reasons_at_3x": flood["reasons"],
    }


def several_objects(frames: list[bytes], seconds: float) -> dict[str, float]:
    """CPU time a frame of the shipped model of eight objects, served and bare, all of them and one."""
    core, found = sorted(os.sched_getaffinity(0))[:1], {}
    with tempfile.TemporaryDirectory() as folder, worker(core) as load, worker(core) as bare:
        shutil.copytree(_SEVERAL, Path(folder) / _SEVERAL.name)
        for asked, objects in _ASKED_FOR.items():
            with running_server(Path(folder), core) as (address, pid):
                target = pose_target(address, frames, pid, model=_SEVERAL.name, objects=objects)
                load(closed_loop_of, target, 1, 1, _SEVERAL_DEADLINE_S)
                before_s = cpu_s(pid)
                load(closed_loop_of, target, 1, _SEVERAL_CALLS, _SEVERAL_DEADLINE_S)
                served_ms = 1000 * (cpu_s(pid) - before_s) / _SEVERAL_CALLS
            found[f"{asked}_frame_ms"] = round(served_ms, 3)
            found[f"bare_{asked}_frame_ms"] = round(bare(bare_cpu_ms, _SEVERAL, frames, 1, seconds, objects), 3)
    return found


def beside_peers(models: Path, frames: list[bytes], seconds: float) -> dict[str, dict[str, Any]]:
    """The same load on ours and on each peer, one after the other."""
    cores = sorted(os.sched_getaffinity(0))
    with worker(cores) as bare:
        raw_ms = bare(bare_cpu_ms, models / MODEL, frames, len(cores), seconds)
    with running_server(models, cores) as (address, pid):
        figures = {"curio": {"version": version("curio-pose"), **load_on(pose_target(address, frames, pid), seconds)}}
    for peer in all_peers():
        python = prepare(peer)
        with running_peer(peer, python, models / MODEL / "1" / "model.onnx", frames, len(cores)) as target:
            found = {"version": installed_version(python, peer.package), **load_on(target, seconds)}
        figures[peer.name] = found
    for found in figures.values():
        found["served_over_raw"] = round(raw_ms / found["cpu_ms"], 3)
    return figures


def load_on(target: Target, seconds: float) -> dict[str, Any]:
    """CPU time a request, answers a second, latency and memory of one server."""
    with worker(sorted(os.sched_getaffinity(0))) as load:
        load(closed_loop, target, 4, _WARM_UP_S)
        alone = load(closed_loop, target, 1, seconds)
        before_s = sum(map(cpu_s, target.processes))
        served = load(closed_loop, target, 4, seconds)
    return {
        "cpu_ms": round(1000 * (sum(map(cpu_s, target.processes)) - before_s) / served["codes"]["OK"], 3),
        "per_s": round(served["goodput"], 1),
        "frame_ms": round(statistics.median(alone["latencies_ms"]), 3),
        "rss_mb": round(sum(memory_mb(pid)[0] for pid in target.processes), 1),
    }


def start_time_s(models: Path) -> float:
    """Seconds from starting a server until it says that it serves."""
    begun = time.perf_counter()
    with running_server(models, sorted(os.sched_getaffinity(0))):
        return time.perf_counter() - begun


@contextmanager
def running_server(
    models: Path, cores: Sequence[int], *flags: str, cgroup: Path | None = None, log: Path | None = None
) -> Iterator[tuple[str, int]]:
    """Address and process id of a server on these cores, once its health service says SERVING.

    Args:
        models: Its models.
        cores: Its cores.
        flags: Of its command line.
        cgroup: Folder of the control group to start it in.
        log: File for its log; None: our stderr.
    """
    program = "from curio_serve.server.serve_cli import main; main()"
    call = [sys.executable, "-c", program, str(models), "--port", "0", "--log-level", "warning", *flags]
    if cgroup:
        call = ["sh", "-c", 'echo $$ > "$0" && exec "$@"', str(cgroup / "cgroup.procs"), *call]
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)  # inherited
    try:
        with contextlib.nullcontext() if log is None else log.open("w") as stderr:
            process = subprocess.Popen(call, stdout=subprocess.PIPE, stderr=stderr, text=True)
    finally:
        os.sched_setaffinity(0, before)
    try:
        assert process.stdout is not None
        address = process.stdout.readline().removeprefix("listening on ").strip()
        with grpc.insecure_channel(address) as channel:
            check = health_pb2_grpc.HealthStub(channel).Check
            answer = check(health_pb2.HealthCheckRequest(), timeout=_START_LIMIT_S, wait_for_ready=True)
        if answer.status != health_pb2.HealthCheckResponse.SERVING:
            raise RuntimeError(f"the server at {address} answers its health check with {answer.status}")
        yield address, process.pid
    finally:
        process.terminate()
        process.wait(timeout=_START_LIMIT_S)


@contextmanager
def plain_server(model_folder: Path, num_threads: int) -> Iterator[tuple[str, int]]:
    """Address and process id of the bare loop behind grpcio's own server."""
    program = Path(__file__).parent / "load" / "plain_server.py"
    call = [sys.executable, str(program), str(model_folder), str(num_threads)]
    process = subprocess.Popen(call, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        yield f"127.0.0.1:{process.stdout.readline().strip()}", process.pid
    finally:
        process.terminate()
        process.wait(timeout=_START_LIMIT_S)


@contextmanager
def worker(cores: Sequence[int]) -> Iterator[Callable[..., Any]]:
    """A fresh process on these cores; what it is called with runs there."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, spawn, os.sched_setaffinity, (0, cores)) as pool:
        yield lambda function, *arguments: pool.submit(function, *arguments).result()


def memory_mb(pid: int) -> tuple[float, float]:
    """Resident memory of a process now and at its largest, MB."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    sizes_kb = {line.split(":")[0]: int(line.split()[1]) for line in lines if line.startswith(("VmRSS", "VmHWM"))}
    return round(sizes_kb["VmRSS"] / 1000, 1), round(sizes_kb["VmHWM"] / 1000, 1)


if __name__ == "__main__":
    main()
