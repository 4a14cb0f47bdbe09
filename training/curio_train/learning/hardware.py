"""Settings that depend on the machine: bfloat16 only where it is quick, and how many threads to compute with.

With AVX2 alone, orthogonalising matrices took 12 to 64 times as long in bfloat16 as in float32 (decision 67). Beside
other jobs on two cores, two threads ran at a third to a sixth of one thread's speed, because each waits for the slower.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch

_NUM_TRIES = 2


def quick_bfloat16(device_type: str) -> bool:
    """Whether devices of this type ("cpu", "cuda") have instructions for products in bfloat16."""
    if device_type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    # torch's own condition for handing such a product to oneDNN; without it torch computes in slow loops.
    return torch.backends.mkldnn.is_available() and bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())


def autocast(precision: str, device_type: str) -> torch.autocast:
    """A context in which convolutions have a recipe's precision; float32 where bfloat16 would be slower."""
    half = precision == "bfloat16" and quick_bfloat16(device_type)
    return torch.autocast(device_type, torch.bfloat16, enabled=half)


def choose_threads(work: Callable[[], object]) -> int:
    """Set torch's number of threads to all it may use, or to one, whichever does ``work`` quicker now.

    Args:
        work: A typical part of what is to be computed.

    Returns:
        That number.
    """
    most = torch.get_num_threads()
    torch.set_num_threads(most if most == 1 else min((1, most), key=lambda count: _seconds(work, count)))
    return torch.get_num_threads()


@contextmanager
def one_thread() -> Iterator[int]:
    """Within the block torch computes each operation in one thread; gives the number that it may use."""
    allowed = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield allowed
    finally:
        torch.set_num_threads(allowed)


def _seconds(work: Callable[[], object], num_threads: int) -> float:
    torch.set_num_threads(num_threads)
    work()  # the first call allocates
    seconds = []
    for _ in range(_NUM_TRIES):
        before = time.monotonic()
        work()
        seconds.append(time.monotonic() - before)
    return min(seconds)
