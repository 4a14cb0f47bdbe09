"""How many threads to compute with: all cores on a machine of one's own, one where others keep the cores busy.

Threads that share a piece of work wait for the slowest. Beside other jobs on two cores, two threads were measured at a
third to a sixth of one thread's speed.
"""

import time
from collections.abc import Callable

import torch

_NUM_TRIES = 2


def choose_threads(work: Callable[[], object]) -> int:
    """Let torch compute with all the threads it may use, or with one, whichever does ``work`` quicker now.

    Returns:
        That number.
    """
    allowed = torch.get_num_threads()
    if allowed > 1:
        quickest = min((1, allowed), key=lambda count: _seconds(work, count))
        torch.set_num_threads(quickest)
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
