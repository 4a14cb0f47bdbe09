"""How many threads to compute with: all cores on a machine of one's own, one where others keep the cores busy.

Threads that share a piece of work wait for the slowest. Beside other jobs on two cores, two threads were measured at a
third to a sixth of one thread's speed.
"""

import time
from collections.abc import Callable

import torch

_NUM_TRIES = 2


def choose_threads(work: Callable[[], object], *, reserved: int = 0) -> int:
    """Let torch compute with all the threads it may use, or with one, whichever does ``work`` quicker now.

    Args:
        work: A piece of what is to be done.
        reserved: Threads that torch leaves to what else this process does at the same time; one stays in any case.

    Returns:
        That number.
    """
    most = max(1, torch.get_num_threads() - reserved)
    torch.set_num_threads(most if most == 1 else min((1, most), key=lambda count: _seconds(work, count)))
    return torch.get_num_threads()


def _seconds(work: Callable[[], object], num_threads: int) -> float:
    torch.set_num_threads(num_threads)
    work()  # the first call allocates
    seconds = []
    for _ in range(_NUM_TRIES):
        before = time.monotonic()
        work()
        seconds.append(time.monotonic() - before)
    return min(seconds)
