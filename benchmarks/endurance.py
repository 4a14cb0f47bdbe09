"""Whether a server stays whole and small: what takes too long for the tests, which run the same with small numbers.

    python benchmarks/endurance.py [--json] [--out FILE]
                                   [--requests 50000] [--replacements 50] [--connections 10000] [--fuzz 100000]
                                   [--attacks 20] [--hostile 60] [--pause 1]

rss_growth            memory after all requests over memory after a tenth of them, after the same pause; at most 1.05
failed_calls          calls of clients with retries that failed while a model was replaced so many times; none may
replaced_answers      answers that came meanwhile, and ``versions_seen`` how many of the versions gave them
connections_survived  so many connections opened with no, half and wrong beginnings and dropped; the next call is right
fuzzed                so many strange requests by ``tests/serving/test_fuzz.py``, each with a defined status and a good
                      answer after it; found failures stay in ``.hypothesis`` and belong into ``tests/serving/corpus``

attacked_mb           largest resident memory of a server under each of the attacks of ``load/attacks.py``, for so many
                      seconds each; ``answered`` the part of the calls of an honest client beside them that is answered
                      within 5 s, ``attacked_stop_s`` how long SIGTERM takes in the middle of the work, and
                      ``attacked_limit_mb`` the limit of the memory cgroup that the server was in, if one can be made
hostile_codes         statuses of the hostile messages of ``load/hostile.py``, sent for so many seconds: none may be
                      UNKNOWN or INTERNAL, and no line of the log a traceback; ``hostile_growth`` is the memory after
                      all of them over that after a tenth
A part is left out with 0. Exit status 1: one of them does not hold. What has been reached is said on stderr. With
``--out`` the figures are written to a file after each part and each 10,000 strange requests, and a run that was cut off
goes on after the last of them; for another version of the server, take another file.
"""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import tyro
from curio_serve.client import PoseClient, detect_request
from curio_serve.errors import CurioError
from load.attacks import empty_calls, idle_streams, much_work, raw_frames, unfinished, unfolding
from load.generator import MODEL, WIDTH, K, closed_loop_of, make_frames, pose_target
from load.hostile import hostile
from load.network import write_model

from serving import memory_mb, running_server, worker

_ROOT = Path(__file__).parents[1]
_OPENINGS = (b"", b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", b"GET / HTTP/1.1\r\n\r\n", bytes(range(64)))
_NUM_FUZZ_TESTS = 4
_FUZZ_ROUND, _FUZZ_LIMIT_S = 10_000, 3600.0
_LARGEST_GROWTH = 1.05
# Of deploy/compose.yaml and deploy/kubernetes/deployment.yaml.
_LARGEST_MB, _LEAST_ANSWERED, _HONEST_S = 1024, 0.9, 5.0


@dataclass(frozen=True)
class Arguments:
    """Measure whether a server stays whole and small."""

    json: bool = False
    """Print one JSON object on the last line instead of a table."""
    out: Path | None = None
    """Write the figures here as they come, and go on from those that are here already."""
    requests: int = 50_000
    """Frames sent between the two looks at memory and before them."""
    replacements: int = 50
    """Times that a model is replaced under load."""
    connections: int = 10_000
    """Connections opened and dropped."""
    fuzz: int = 100_000
    """Strange requests."""
    attacks: float = 20.0
    """Seconds of each attack."""
    hostile: float = 60.0
    """Seconds of hostile messages."""
    pause: float = 1.0
    """Seconds of rest before each look at memory."""


def main() -> None:
    """Measures, prints, and leaves nothing behind but what the fuzzing found."""
    arguments = tyro.cli(Arguments)
    frames = make_frames(8)
    out = arguments.out
    figures: dict[str, Any] = json.loads(out.read_text()) if out and out.exists() else {}
    with tempfile.TemporaryDirectory() as name:
        models = Path(name)
        write_model(models / MODEL, K, WIDTH)
        parts = (
            ("rss_growth", partial(memory, pause_s=arguments.pause), arguments.requests),
            ("connections_survived", connections, arguments.connections),
            ("failed_calls", replacements, arguments.replacements),
            ("attacked_mb", attacked, arguments.attacks),
            ("hostile_codes", partial(hostile_messages, pause_s=arguments.pause), arguments.hostile),
        )
        for figure, part, number in parts:
            if number and figure not in figures:
                figures |= part(models, frames, number)
                _keep(figures, out)
    while (num_left := arguments.fuzz - figures.get("fuzzed", 0)) >= _NUM_FUZZ_TESTS:
        figures |= fuzzing(min(num_left, _FUZZ_ROUND), figures.get("fuzzed", 0))
        _keep(figures, out)
        if figures["fuzz_status"]:
            break
    print(json.dumps(figures) if arguments.json else "\n".join(f"{k:22} {v}" for k, v in figures.items()))
    holds = (
        figures.get("rss_growth", 1.0) <= _LARGEST_GROWTH
        and figures.get("hostile_growth", 1.0) <= _LARGEST_GROWTH
        and not figures.get("hostile_tracebacks")
        and not {"UNKNOWN", "INTERNAL"} & figures.get("hostile_codes", {}).keys()
        and not figures.get("failed_calls")
        and figures.get("fuzz_status", 0) == 0
        and max(figures.get("attacked_mb", {"": 0}).values()) <= _LARGEST_MB
        and all(part >= _LEAST_ANSWERED for part in figures.get("answered", {}).values())
    )
    sys.exit(0 if holds else 1)


def _keep(figures: dict[str, Any], out: Path | None) -> None:
    _say(json.dumps(figures))
    if out:
        fresh = out.with_name(f"{out.name}.tmp")
        fresh.write_text(f"{json.dumps(figures)}\n")
        fresh.replace(out)


def _say(text: str) -> None:
    print(f"{time.strftime('%H:%M:%S')} {text}", file=sys.stderr, flush=True)


def memory(models: Path, frames: list[bytes], num_requests: int, pause_s: float) -> dict[str, Any]:
    """Resident memory after a tenth of the requests and after all."""
    cores = sorted(os.sched_getaffinity(0))
    with running_server(models, cores) as (address, pid), worker(cores) as load:
        target = pose_target(address, frames)
        codes: Counter[str] = Counter()
        sizes_mb = []
        for tenth in range(10):
            share = num_requests // 10 if tenth < 9 else num_requests - 9 * (num_requests // 10)
            codes.update(load(closed_loop_of, target, 4, share))
            time.sleep(pause_s)
            sizes_mb.append(memory_mb(pid)[0])
            _say(f"{codes.total()} of {num_requests} requests, {sizes_mb[-1]} MB")
    return {
        "rss_growth": round(sizes_mb[-1] / sizes_mb[0], 4),
        "rss_early_mb": sizes_mb[0],
        "rss_late_mb": sizes_mb[-1],
        "codes": dict(codes),
    }


def connections(models: Path, frames: list[bytes], num_connections: int) -> dict[str, Any]:
    """Open, begin, drop; then a good call."""
    with running_server(models, sorted(os.sched_getaffinity(0))) as (address, pid):
        host, port = address.rsplit(":", 1)
        before_mb, _ = memory_mb(pid)
        for number in range(num_connections):
            with socket.create_connection((host, int(port)), timeout=30) as connection:
                connection.sendall(_OPENINGS[number % len(_OPENINGS)])
        with PoseClient(address, timeout_s=60) as client:
            assert client.detect(MODEL, frames[0], K).results
        after_mb, _ = memory_mb(pid)
    return {"connections_survived": num_connections, "rss_of_connections_mb": round(after_mb - before_mb, 1)}


def replacements(models: Path, frames: list[bytes], num_replacements: int) -> dict[str, Any]:
    """Clients with retries go on while new versions come, old ones go, and a broken one is refused."""
    over, seen, failures = threading.Event(), set(), []

    def ask(client: PoseClient) -> int:
        num_answers = 0
        while not over.is_set():
            try:
                answer = client.detect(MODEL, frames[num_answers % len(frames)], K, timeout_s=30)
            except CurioError as exc:
                failures.append(str(exc))
                continue
            seen.add(answer.results[0].model_version)
            num_answers += 1
        return num_answers

    first = models / MODEL / "1" / "model.onnx"
    flags = ("--refresh-s", "0.1", "--versions", "1")
    with (
        running_server(models, sorted(os.sched_getaffinity(0)), *flags) as (address, _),
        PoseClient(address, max_attempts=20) as client,
        ThreadPoolExecutor(2) as pool,
    ):
        asking = [pool.submit(ask, client) for _ in range(2)]
        try:
            for version in range(2, num_replacements + 2):
                _put(models / MODEL / str(version), first.read_bytes())
                _wait_until(lambda wanted=version: wanted in seen)
                if version % 10 == 1:
                    _say(f"{version - 1} of {num_replacements} replacements")
            _put(models / MODEL / str(num_replacements + 2), b"broken")
            time.sleep(2)
        finally:
            over.set()
        num_answers = sum(call.result() for call in asking)
    if num_replacements + 2 in seen:
        failures.append("a broken version answered")
    return {"failed_calls": len(failures), "replaced_answers": num_answers, "versions_seen": len(seen)}


def attacked(models: Path, frames: list[bytes], seconds: float) -> dict[str, Any]:
    """Each attack on a server of its own, beside an honest client; SIGTERM while the attack goes on."""
    peaks_mb, parts, stops_s = {}, {}, {}
    cores = sorted(os.sched_getaffinity(0))
    for attack in (unfolding, raw_frames, much_work, unfinished, empty_calls, idle_streams):
        with (
            _memory_cgroup() as cgroup,
            running_server(models, cores, "--grace-s", "3", cgroup=cgroup) as (address, pid),
            worker(cores) as attacker,
            ThreadPoolExecutor(1) as pool,
        ):
            running = pool.submit(attacker, attack, address, seconds)
            parts[attack.__name__] = _honest_part(address, frames[0], seconds - 2)
            peaks_mb[attack.__name__] = memory_mb(pid)[1]
            begun = time.monotonic()
            os.kill(pid, signal.SIGTERM)
            _wait_until(lambda pid=pid: _has_ended(pid))
            stops_s[attack.__name__] = round(time.monotonic() - begun, 2)
            _say(f"{attack.__name__}: {running.result()} calls, {peaks_mb}, {parts}, {stops_s}")
    limit_mb = None if cgroup is None else _LARGEST_MB
    return {"attacked_mb": peaks_mb, "answered": parts, "attacked_stop_s": stops_s, "attacked_limit_mb": limit_mb}


@contextmanager
def _memory_cgroup() -> Iterator[Path | None]:
    """The folder of a memory cgroup with the container's limit, of version 1 or 2; None if none can be made."""
    for root, limit in (("/sys/fs/cgroup/memory", "memory.limit_in_bytes"), ("/sys/fs/cgroup", "memory.max")):
        folder = Path(root) / f"curio-endurance-{os.getpid()}"
        try:
            folder.mkdir()
        except OSError:
            continue
        try:
            (folder / limit).write_text(str(_LARGEST_MB << 20))
            yield folder
        finally:
            folder.rmdir()
        return
    yield None


def hostile_messages(models: Path, frames: list[bytes], seconds: float, pause_s: float) -> dict[str, Any]:
    """Hostile messages in ten parts, a good call after each."""
    cores = sorted(os.sched_getaffinity(0))
    codes: Counter[str] = Counter()
    sizes_mb = []
    log = models.with_name(f"{models.name}.log")
    with (
        running_server(models, cores, log=log) as (address, pid),
        worker(cores) as attacker,
        PoseClient(address, timeout_s=60) as client,
    ):
        for part in range(10):
            codes.update(attacker(hostile, address, part, seconds / 10))
            assert client.detect(MODEL, frames[0], K).results
            time.sleep(pause_s)
            sizes_mb.append(memory_mb(pid)[0])
            _say(f"{codes.total()} hostile messages, {sizes_mb[-1]} MB, {dict(codes)}")
    num_tracebacks = log.read_text(errors="replace").count("Traceback")
    log.unlink()
    return {
        "hostile_messages": codes.total(),
        "hostile_codes": dict(codes),
        "hostile_growth": round(sizes_mb[-1] / sizes_mb[0], 4),
        "hostile_tracebacks": num_tracebacks,
    }


def _has_ended(pid: int) -> bool:
    """Whether a child has ended, which its parent has not yet asked about."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"


def _honest_part(address: str, frame: bytes, seconds: float) -> float:
    """The part of a client's calls, five a second, and streams, that are answered within 5 s."""
    codes: Counter[bool] = Counter()
    request = detect_request(MODEL, frame, K)
    end = time.monotonic() + seconds
    with PoseClient(address, timeout_s=_HONEST_S) as client:
        while time.monotonic() < end:
            try:
                codes[bool(client.detect(MODEL, frame, K).results)] += 1
                codes[bool(next(client.detect_stream([request], timeout_s=_HONEST_S)).results)] += 1
            except CurioError as exc:
                _say(f"an honest call failed: {exc}")
                codes[False] += 1
            time.sleep(0.2)
    return round(codes[True] / codes.total(), 3)


def _put(folder: Path, data: bytes) -> None:
    """A version that appears as a whole."""
    fresh = folder.with_name(f"coming-{folder.name}")
    fresh.mkdir()
    (fresh / "model.onnx").write_bytes(data)
    fresh.rename(folder)
    for old in (entry for entry in folder.parent.iterdir() if entry.name.isdecimal()):
        if 1 < int(old.name) < int(folder.name) - 2:
            shutil.rmtree(old)


def _wait_until(is_so: Any, limit_s: float = 120.0) -> None:
    end = time.monotonic() + limit_s
    while not is_so():
        if time.monotonic() > end:
            raise RuntimeError(f"a new version did not come to serve within {limit_s:g} s")
        time.sleep(0.02)


def fuzzing(num_requests: int, num_before: int) -> dict[str, Any]:
    """The fuzz tests with that many examples in all, others than before. A round that fails does not count."""
    environment = {**os.environ, "CURIO_FUZZ_EXAMPLES": str(num_requests // _NUM_FUZZ_TESTS)}
    tests = str(_ROOT / "tests" / "serving" / "test_fuzz.py")
    call = [sys.executable, "-m", "pytest", "-q", f"--hypothesis-seed={num_before}", tests]
    process = subprocess.Popen(call, cwd=_ROOT, env=environment, stdout=sys.stderr)
    try:
        status = process.wait(_FUZZ_LIMIT_S)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)  # it ends its server then
        status = process.wait(60) or 1
    done = 0 if status else num_requests // _NUM_FUZZ_TESTS * _NUM_FUZZ_TESTS
    return {"fuzzed": num_before + done, "fuzz_status": status}


if __name__ == "__main__":
    main()
