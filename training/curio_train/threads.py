"""Several batches at once: a network of many small operations gains more by it than by threads within each of them."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_threads(function: Callable[[Item], Result], items: Iterable[Item], num_threads: int) -> Iterator[Result]:
    """As ``map``, with several calls at once, each of which computes in one thread.

    Args:
        function: Called in other threads, which record no gradients.
        items: Made in this thread, few of them ahead.
        num_threads: How many calls at once.

    Raises:
        Exception: Whatever ``function`` raised.
    """
    allowed = torch.get_num_threads()
    pending = deque[Future[Result]]()
    with ThreadPoolExecutor(num_threads, "in-threads", _begin) as threads:
        try:
            for item in items:
                pending.append(threads.submit(function, item))
                if len(pending) > num_threads:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            threads.shutdown(cancel_futures=True)
            torch.set_num_threads(allowed)  # the other threads' calls changed the whole process


def compute_alone() -> None:
    """Keep torch from starting further threads for what the calling one computes.

    That changes the number of the whole process, which another thread has to set again.
    """
    torch.set_num_threads(1)
    torch.get_num_threads()  # a thread takes up the process's number when it first asks, and keeps it


def _begin() -> None:
    compute_alone()
    torch.set_grad_enabled(False)
