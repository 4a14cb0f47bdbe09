"""Frames, a bare loop over them, and load on a server. The functions run in processes of their own."""

import asyncio
import math
import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import grpc
import numpy as np

WIDTH, HEIGHT = 640, 480
K = np.array([[572.4114, 0, 325.2611], [0, 573.57043, 242.04899], [0, 0, 1]])
MODEL = "paper"
DEADLINE_S = 1.0
_METHOD = "/curio.v1.PoseDetector/Detect"


def make_frames(num_frames: int = 24) -> list[bytes]:
    """640x480 JPEGs with about the spectrum of photographs (amplitude falling as 1/f)."""
    rng = np.random.default_rng(0)
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(WIDTH), np.fft.fftfreq(HEIGHT)))
    frequency[0, 0] = 1
    frames = []
    for _ in range(num_frames):
        planes = np.fft.ifft2(np.fft.fft2(rng.normal(size=(3, HEIGHT, WIDTH))) / frequency**1.35).real
        pixels = np.clip(127 + 45 * planes / planes.std(), 0, 255).astype(np.uint8).transpose(1, 2, 0)
        frames.append(cv2.imencode(".jpg", np.ascontiguousarray(pixels), [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes())
    return frames


def bare_loop(model_folder: Path, objects: Sequence[str] = ()) -> Callable[[bytes], None]:
    """Decode, warp and session alone, for one frame and the objects asked for (none: all); for several threads."""
    from curio_serve.imaging.camera import PinholeCamera
    from curio_serve.imaging.image import decode, open_header
    from curio_serve.imaging.view import PinholeFrame, Region
    from curio_serve.models.detector import Detector
    from curio_serve.models.model import answering
    from curio_serve.models.model_folder import open_model

    cv2.setNumThreads(1)
    (model,) = answering([open_model(model_folder)], objects)
    camera, region = PinholeCamera(K), Region(0, 0, WIDTH, HEIGHT)
    detector = Detector(model)

    def one(data: bytes) -> None:
        header = open_header(data)
        reduction = detector.reduction(camera, header.width, header.height)
        frame = decode(data, header=header, max_reduction=reduction)
        view = PinholeFrame(frame.pixels, camera, model.camera, frame.reduction).crop(region)
        model.run(view.image[None])

    return one


def bare_cpu_ms(
    model_folder: Path, frames: list[bytes], num_threads: int, seconds: float, objects: Sequence[str] = ()
) -> float:
    """CPU milliseconds a frame of the bare loop, in as many threads as the server has workers."""
    one = bare_loop(model_folder, objects)

    def work_until(end: float) -> int:
        num_done = 0
        while time.perf_counter() < end:
            one(frames[num_done % len(frames)])
            num_done += 1
        return num_done

    with ThreadPoolExecutor(num_threads) as threads:
        list(threads.map(one, frames[: 4 * num_threads]))  # warm
        before = time.process_time()
        end = time.perf_counter() + seconds
        num_done = sum(threads.map(work_until, [end] * num_threads))
        return 1000 * (time.process_time() - before) / num_done


def bare_latencies_ms(model_folder: Path, frames: list[bytes], rate: float, seconds: float) -> list[float]:
    """Latencies of the bare loop in one thread over frames that come evenly (infinite rate: one after the other)."""
    one = bare_loop(model_folder)
    for frame in frames:
        one(frame)  # warm
    latencies_ms = []
    due = time.perf_counter()
    end = due + seconds
    while due < end:
        time.sleep(max(0.0, due - time.perf_counter()))
        one(frames[len(latencies_ms) % len(frames)])
        done = time.perf_counter()
        latencies_ms.append(1000 * (done - due))
        due = done if rate == math.inf else due + 1 / rate
    return latencies_ms


def bare_folder(model_folder: str, frames: str, num_threads: str) -> None:
    """The bare loop over the files of a folder, as a program of its own."""
    one = bare_loop(Path(model_folder))
    with ThreadPoolExecutor(int(num_threads)) as threads:
        for _ in threads.map(lambda path: one(path.read_bytes()), sorted(Path(frames).iterdir())):
            pass


def cpu_s(pid: int) -> float:
    """User and system time that a process has used, all threads."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Target:
    """A server and the calls that are put on it.

    Attributes:
        address: host:port.
        method: gRPC's path of the call.
        requests: Serialised messages, sent in turn.
        processes: The server's.
    """

    address: str
    method: str
    requests: list[bytes]
    processes: tuple[int, ...] = ()


def pose_target(
    address: str, frames: list[bytes], *processes: int, model: str = MODEL, objects: Sequence[str] = ()
) -> Target:
    """``Detect`` calls with these frames."""
    from curio_proto.v1.detector_pb2 import Camera, DetectRequest, ModelSelector

    camera, models = Camera(camera_matrix=K.ravel()), [ModelSelector(name=model)]
    requests = [DetectRequest(models=models, camera=camera, encoded=frame, objects=objects) for frame in frames]
    return Target(address, _METHOD, [request.SerializeToString() for request in requests], processes)


def closed_loop(target: Target, concurrency: int, seconds: float) -> dict[str, Any]:
    """That many callers, each of whom sends the next frame when it has the answer to the last."""
    return asyncio.run(_closed_loop(target, concurrency, seconds))


def closed_loop_of(target: Target, concurrency: int, num_calls: int, deadline_s: float = DEADLINE_S) -> dict[str, int]:
    """The same for that many calls; how many ended with each code."""
    return asyncio.run(_closed_loop_of(target, concurrency, num_calls, deadline_s))


def open_loop(target: Target, rate: float, seconds: float, deadline_s: float = DEADLINE_S) -> dict[str, Any]:
    """Frames that come evenly, whether or not earlier ones are answered. Latency counts from when one was due."""
    return asyncio.run(_open_loop(target, rate, seconds, deadline_s))


async def _closed_loop(target: Target, concurrency: int, seconds: float) -> dict[str, Any]:
    async with grpc.aio.insecure_channel(target.address) as channel:
        record = _Record(channel, target)
        begun = time.perf_counter()
        end = begun + seconds

        async def caller() -> None:
            while time.perf_counter() < end:
                await record.call(time.perf_counter())

        await asyncio.gather(*(caller() for _ in range(concurrency)))
        return record.summary(time.perf_counter() - begun)


async def _closed_loop_of(target: Target, concurrency: int, num_calls: int, deadline_s: float) -> dict[str, int]:
    async with grpc.aio.insecure_channel(target.address) as channel:
        record = _Record(channel, target, deadline_s)
        numbers = iter(range(num_calls))

        async def caller() -> None:
            for _ in numbers:  # shared, so that the callers do them all together
                await record.call(time.perf_counter())

        await asyncio.gather(*(caller() for _ in range(concurrency)))
        return dict(record.codes)


async def _open_loop(target: Target, rate: float, seconds: float, deadline_s: float) -> dict[str, Any]:
    async with grpc.aio.insecure_channel(target.address) as channel:
        record = _Record(channel, target, deadline_s)
        begun = time.perf_counter()
        calls = set()
        due = begun
        while due < begun + seconds:
            await asyncio.sleep(max(0.0, due - time.perf_counter()))
            call = asyncio.create_task(record.call(due))
            calls.add(call)
            call.add_done_callback(calls.discard)
            due = max(due + 1 / rate, time.perf_counter() - 0.1)  # what cannot be made is not owed for ever
        made_in = time.perf_counter() - begun
        await asyncio.gather(*calls)
        return record.summary(made_in)


class _Record:
    """Calls on one channel, and what became of them."""

    def __init__(self, channel: grpc.aio.Channel, target: Target, deadline_s: float = DEADLINE_S) -> None:
        self._requests, self._deadline_s = target.requests, deadline_s
        self._call = channel.unary_unary(target.method)
        self.codes: Counter[str] = Counter()
        self._reasons: dict[str, str] = {}
        self._latencies_ms: list[float] = []

    async def call(self, due: float) -> None:
        request = self._requests[self.codes.total() % len(self._requests)]
        try:
            await self._call(request, timeout=self._deadline_s)
        except grpc.aio.AioRpcError as exc:
            self.codes[exc.code().name] += 1
            self._reasons.setdefault(exc.code().name, exc.details() or "")
            return
        self.codes["OK"] += 1
        self._latencies_ms.append(1000 * (time.perf_counter() - due))

    def summary(self, seconds: float) -> dict[str, Any]:
        """Codes, what the first call of each bad one was told, latencies of good answers, and rates a second."""
        good = sum(latency <= 1000 * self._deadline_s for latency in self._latencies_ms)
        return {
            "codes": dict(self.codes),
            "reasons": self._reasons,
            "latencies_ms": self._latencies_ms,
            "goodput": good / seconds,
            "offered": self.codes.total() / seconds,
        }
