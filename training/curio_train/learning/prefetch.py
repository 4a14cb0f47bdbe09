"""A thread that makes the next item while the caller works with this one."""

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import Generic, TypeVar

import torch

from curio_train.threads import compute_alone

Item = TypeVar("Item")


class Prefetcher(Generic[Item]):
    """Makes numbered items in one thread, at most one ahead of what was taken; see :func:`prefetching`."""

    def __init__(self, make: Callable[[int], Item], stride: int, thread: ThreadPoolExecutor) -> None:
        self._make, self._stride, self._thread = make, stride, thread
        self._next: tuple[int, Future[Item]] | None = None

    def take(self, number: int) -> Item:
        """The item of that number; the thread begins with the next one.

        Raises:
            Exception: Whatever ``make`` raised.
        """
        if self._next is None or self._next[0] != number:
            self._next = self._begin(number)
        item = self._next[1].result()
        self._next = self._begin(number + self._stride)
        return item

    def wait_idle(self) -> None:
        """Wait until the thread is idle, so that the caller may use what ``make`` uses."""
        if self._next is not None:
            wait([self._next[1]])

    def _begin(self, number: int) -> tuple[int, Future[Item]]:
        return number, self._thread.submit(self._make, number)


@contextmanager
def prefetching(make: Callable[[int], Item], stride: int) -> Iterator[Prefetcher[Item]]:
    """Within it a thread makes items ahead; it ends with the block, at the latest when the item at hand is made.

    Args:
        make: Returns the item of a number; it depends on the number alone, so that the thread changes no item.
        stride: From one number to the next that will be asked for.
    """
    allowed = torch.get_num_threads()
    thread = ThreadPoolExecutor(1, thread_name_prefix="prefetch")
    thread.submit(compute_alone).result()  # the other cores belong to the training step
    torch.set_num_threads(allowed)  # the other thread's call changed the whole process
    try:
        yield Prefetcher(make, stride, thread)
    finally:
        thread.shutdown(cancel_futures=True)
