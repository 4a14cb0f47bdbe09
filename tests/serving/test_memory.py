"""Freed memory stays with a process that asks for it, and only with glibc."""

import platform
import subprocess
import sys

import pytest

# 64 MiB are more than glibc ever keeps by itself. Pages may be huge, so faults are compared, not counted.
FAULTS = """
import resource, numpy
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(8):
        numpy.empty(64 << 20, numpy.uint8).fill(1)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries have rules of their own")
@pytest.mark.parametrize(
    "ask",
    [
        "from curio_serve.memory import keep_freed; keep_freed()",
        "from curio_train.commands.command_line.running import answer; answer(lambda _: 0)",
    ],
    ids=["by itself", "a command of training"],
)
def test_freed_memory_is_kept(ask: str) -> None:
    """The first tensor takes its pages from the system, the others the same ones again."""
    program = f"{FAULTS}\nbefore = faults()\n{ask}\nfaults()\nprint(before, faults())"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    before, after = map(int, done.stdout.split())
    assert before >= 8 * 32, "the system gives no new pages: nothing is tried here"
    assert after < before / 10


def test_freed_memory_is_returned() -> None:
    """In a process of its own: where tests trained before, there is freed memory already."""
    program = """
from curio_serve.memory import give_back, resident_bytes
before = resident_bytes()
held = [b"x" * 10_000 for _ in range(10_000)]
full = resident_bytes()
held.clear()
give_back()
print(full - before, resident_bytes() - before)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    full, after = map(int, done.stdout.split())
    assert after < 50 << 20 < full
