"""Hostile messages, one after the other and never twice the same: known attacks with bits flipped and pieces moved."""

import random
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import grpc

_CORPUS = Path(__file__).parents[2] / "tests" / "serving" / "corpus"
_PATHS = {
    "Detect": "/curio.v1.PoseDetector/Detect",
    "GetModel": "/curio.v1.PoseDetector/GetModel",
    "ModelInfer": "/inference.GRPCInferenceService/ModelInfer",
}
_AT_ONCE = 32


def hostile(address: str, seed: int, seconds: float) -> dict[str, int]:
    """Send for so many seconds; how often each status was the answer."""
    codes: Counter[str] = Counter()
    free = threading.Semaphore(_AT_ONCE)

    def ended(call: Any) -> None:
        codes[call.code().name] += 1
        free.release()

    end = time.monotonic() + seconds
    with grpc.insecure_channel(address) as channel:
        calls = {method: channel.unary_unary(path) for method, path in _PATHS.items()}
        for method, data in _messages(random.Random(seed)):
            if time.monotonic() > end:
                break
            free.acquire()
            calls[method].future(data, timeout=20).add_done_callback(ended)
        for _ in range(_AT_ONCE):
            free.acquire()
    return dict(codes)


def _messages(draw: random.Random) -> Iterator[tuple[str, bytes]]:
    """Method and message, without end."""
    known = [(path.name.partition("-")[0], path.read_bytes()) for path in sorted(_CORPUS.glob("*.bin"))]
    while True:
        method, data = draw.choice(known)
        yield draw.choice([method, method, *_PATHS]), _mutated(data, draw)


def _mutated(data: bytes, draw: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(draw.randint(1, 4)):
        start = draw.randrange(len(changed) + 1)
        kind = draw.randrange(4)
        if kind == 0 and start < len(changed):
            changed[start] ^= 1 << draw.randrange(8)
        elif kind == 1:
            changed[start:start] = draw.randbytes(draw.randint(1, 12))
        elif kind == 2:
            del changed[start : start + draw.randint(1, 12)]
        else:
            changed[start:start] = changed[: draw.randint(0, 200)]
    return bytes(changed)
