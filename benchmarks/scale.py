"""Many images from an object store over a Ray cluster: speed by workers, and memory over time.

    pip install 'curio-pose[ray]'
    python benchmarks/scale.py [--json] [--num-files 1000] [--repeats 100] [--minutes 70] [--out FILE]

An S3 server (moto) and the cluster run on this machine, on loopback. The shipped frames of samples/, brightened each in
its own way, are the files; a list names all of them again and again. curio-detect --ray answers the whole list with two
workers and a small model, the paper's network with random weights (``load.network``), and one worker is killed on the
way. Every ten seconds the figures so far are written. After --minutes the run is stopped, and the figures are those of
the images that it answered. Then that model and models/ape are timed on --num-timed images, each with one worker and
with two.
"""

import json
import os
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import boto3
import cv2
import numpy as np
import tyro
from curio_train.learning.runs.provenance import commit, machine
from load.generator import WIDTH, K
from load.network import write_model

_SAMPLES, _APE = Path("samples"), Path("models/ape")
_NUM_SETTLED = 5000  # images after which memory is taken as the measure
_SAMPLE_S = 10.0
_START_S = 60.0
_MEBIBYTE = 1 << 20


@dataclass(frozen=True)
class Options:
    """What is measured."""

    json: bool = False
    """Print the figures as one JSON object on the last line."""
    num_files: int = 1000
    """Files in the store."""
    repeats: int = 100
    """How often the list names each."""
    num_timed: int = 2000
    """Images for each figure of a model with one worker or two."""
    minutes: float = 70.0
    """For the whole list; the run is then stopped."""
    out: Path = Path("docs/results/scale.json")
    """Figures so far, while it runs."""


def free_port() -> int:
    """A port of loopback that nobody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        return int(listening.getsockname()[1])


@contextmanager
def process(*command: str | Path, port: int | None = None) -> Iterator["subprocess.Popen[bytes]"]:
    """A process in a group of its own, which ends with the block; with a port, once it listens there."""
    errors = subprocess.DEVNULL if port is not None else None  # servers tell each request
    call = [*map(str, command)]
    started = subprocess.Popen(call, stdout=subprocess.DEVNULL, stderr=errors, start_new_session=True)
    try:
        if port is not None:
            _wait_for_port(port)
        yield started
    finally:
        with suppress(ProcessLookupError):
            os.killpg(started.pid, signal.SIGTERM)
        try:
            started.wait(30)
        except subprocess.TimeoutExpired:
            os.killpg(started.pid, signal.SIGKILL)
            started.wait()


def _wait_for_port(port: int) -> None:
    end = time.monotonic() + _START_S
    while True:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1).close()
            return
        except OSError:
            if time.monotonic() > end:
                raise
            time.sleep(0.2)


def fill(options: Options) -> None:
    """The files and two lists of them: of all, and of those that are timed."""
    client = boto3.client("s3")
    client.create_bucket(Bucket="scale")
    frames = [cv2.imread(str(path)) for path in sorted(_SAMPLES.glob("*.jpg"))]
    names = [f"{number:06d}.jpg" for number in range(options.num_files)]
    for number, name in enumerate(names):
        frame = frames[number % len(frames)]
        assert frame is not None
        brighter = np.clip(frame * (0.8 + 0.4 * number / len(names)), 0, 255).astype(np.uint8)
        client.put_object(Bucket="scale", Key=name, Body=cv2.imencode(".jpg", brighter)[1].tobytes())
    lists = {"all.txt": names * options.repeats, "timed.txt": (names * options.repeats)[: options.num_timed]}
    for key, listed in lists.items():
        client.put_object(Bucket="scale", Key=key, Body="\n".join(listed).encode())


@contextmanager
def detecting(model: Path, source: str, out: Path, num_workers: int) -> Iterator[tuple["subprocess.Popen[bytes]", int]]:
    """``curio-detect --ray`` with so many workers, and the process that holds its cluster."""
    port = free_port()
    ray: list[str | Path] = [Path(sys.executable).with_name("ray"), "start", "--head", "--block", f"--port={port}"]
    ray += ["--node-ip-address=127.0.0.1", f"--num-cpus={num_workers}", "--include-dashboard=false"]
    program = "from curio_serve.batch.detect_cli import main; main()"
    detect: list[str | Path] = [sys.executable, "-c", program, model, source, "--camera", _SAMPLES / "camera.json"]
    detect += ["--ray", f"127.0.0.1:{port}", "--out", out]
    with process(*ray, port=port) as cluster, process(*detect) as run:
        yield run, cluster.pid


def count(out: Path) -> int:
    """Complete lines so far."""
    return out.read_bytes().count(b"\n") if out.exists() else 0


def timed(model: Path, options: Options, num_workers: int, folder: Path) -> dict[str, float]:
    """From the middle of the images to the last, so that the start of the workers does not count.

    Returns:
        Images a second, and CPU time an image in milliseconds, of workers, cluster and command together.
    """
    out = folder / f"timed-{model.name}-{num_workers}.jsonl"
    samples: list[tuple[int, float, float]] = []  # rows, then seconds of the clock and of CPU
    with detecting(model, "s3://scale/timed.txt", out, num_workers) as (run, cluster):
        while run.poll() is None:
            num_rows = count(out)
            if num_rows >= options.num_timed / 2 and (not samples or num_rows > samples[-1][0]):
                samples.append((num_rows, time.monotonic(), cpu_s(tree(cluster, run.pid))))
            time.sleep(0.05)
    if len(samples) < 3:
        sys.exit(f"{out.name}: the answers came in {len(samples)} blocks; --num-timed has to be larger")
    # The last sample may have been taken while the command ended, and then lacks its CPU time.
    rows, wall_s, used_s = np.subtract(samples[-2], samples[0])
    return {"images_per_second": round(rows / wall_s, 2), "cpu_ms_an_image": round(1000 * used_s / rows, 2)}


def tree(*roots: int) -> list[int]:
    """The processes and all below them."""
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        with suppress(OSError, ValueError):
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            children.setdefault(parent, []).append(int(entry.name))
    found = list(roots)
    for number in found:
        found += children.get(number, [])
    return found


def resident_mib(processes: list[int]) -> float:
    """Resident memory, what a process shares with others counted in each."""
    pages = 0
    for number in processes:
        with suppress(OSError):
            pages += int(Path(f"/proc/{number}/statm").read_text().split()[1])
    return round(pages * os.sysconf("SC_PAGE_SIZE") / _MEBIBYTE, 1)


def cpu_s(processes: list[int]) -> float:
    """CPU time of processes since their start."""
    ticks = 0
    for number in processes:
        with suppress(OSError):
            ticks += sum(map(int, Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[11:13]))
    return ticks / os.sysconf("SC_CLK_TCK")


def kill_worker(processes: list[int]) -> bool:
    """Kill one of the actors that hold the model."""
    for number in processes:
        with suppress(OSError):
            if b"MapWorker" in Path(f"/proc/{number}/cmdline").read_bytes():
                os.kill(number, signal.SIGKILL)
                return True
    return False


def whole_list(options: Options, model: Path, folder: Path, figures: dict[str, Any]) -> None:
    """Answers the list, with a worker killed once memory has settled; adds to the figures and writes them."""
    out = folder / "all.jsonl"
    memory: list[dict[str, float]] = []
    started, end = time.monotonic(), time.monotonic() + 60 * options.minutes
    is_killed = False
    with detecting(model, "s3://scale/all.txt", out, 2) as (run, cluster):
        while run.poll() is None and time.monotonic() < end:
            time.sleep(_SAMPLE_S)
            if run.poll() is not None or not (num_rows := count(out)):
                continue
            processes = tree(cluster, run.pid)
            sample = {"seconds": round(time.monotonic() - started, 1), "rows": num_rows}
            memory.append(sample | {"all_mib": resident_mib(processes), "command_mib": resident_mib([run.pid])})
            if not is_killed and num_rows > min(_NUM_SETTLED, options.num_files * options.repeats / 4):
                is_killed = kill_worker(processes)
                figures["killed_after_rows"] = num_rows
            figures |= {"rows": num_rows, "memory": memory}
            write(options, figures)
        is_finished = run.poll() is not None
        if not is_finished:
            run.send_signal(signal.SIGTERM)
            run.wait()
    figures |= check(out, options) | {"is_finished": is_finished, "worker_killed": is_killed}
    figures["seconds"] = round(time.monotonic() - started, 1)
    settled = [sample for sample in memory if sample["rows"] >= _NUM_SETTLED]
    if settled:
        for key in ("all_mib", "command_mib"):
            later = [sample[key] for sample in settled]
            figures[f"most_{key}_over_that_after_{_NUM_SETTLED}"] = round(max(later) / later[0], 3)
    write(options, figures)


def check(out: Path, options: Options) -> dict[str, int]:
    """Whether each image of the list, as far as it was answered, has its one row in its place."""
    with out.open("rb") as lines:
        names = [json.loads(line)["image"] for line in lines]
    listed = [f"s3://scale/{number:06d}.jpg" for number in range(options.num_files)] * options.repeats
    too_many = Counter(names) - Counter(listed[: len(names)])
    wrong = sum(found != expected for found, expected in zip(names, listed, strict=False))
    return {"rows": len(names), "rows_of_the_list": len(listed), "rows_wrong": wrong + too_many.total()}


def write(options: Options, figures: dict[str, Any]) -> None:
    """The figures so far."""
    options.out.write_text(json.dumps(figures) + "\n")


def main(options: Options) -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that the processes below end, too
    port = free_port()
    os.environ |= {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
        "AWS_ACCESS_KEY_ID": "id",
        "AWS_SECRET_ACCESS_KEY": "key",
        "AWS_DEFAULT_REGION": "us-east-1",
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_AUTH_MODE": "token",  # the cluster answers to this run alone
        "RAY_AUTH_TOKEN": secrets.token_hex(32),
    }
    figures: dict[str, Any] = {"machine": machine(), "commit": commit()}
    figures["load_average_before"] = round(os.getloadavg()[0], 1)
    store = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    with tempfile.TemporaryDirectory() as name, process(*store, port=port):
        fill(options)
        small = Path(name) / "paper"
        write_model(small, K, WIDTH)
        whole_list(options, small, Path(name), figures)
        for model, num_workers in product((small, _APE), (1, 2)):
            figures[f"{model.name}_with_{num_workers}"] = timed(model, options, num_workers, Path(name))
            write(options, figures)
    if options.json:
        print(json.dumps(figures))
        return
    for key in (f"{name}_with_{num_workers}" for name in ("paper", "ape") for num_workers in (1, 2)):
        print(f"{key:13} {figures[key]}")
    print(f"rows {figures['rows']} of {figures['rows_of_the_list']}, {figures['rows_wrong']} of them wrong")


if __name__ == "__main__":
    main(tyro.cli(Options))
