"""A thread that makes the next item while the caller works with this one."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from types import TracebackType
from typing import Generic, Self, TypeVar

import torch

Item = TypeVar("Item")


class Prefetcher(Generic[Item]):
    """Makes numbered items one at a time, at most one ahead of what was taken; the thread ends with the block.

    Items must depend on their number alone: then those taken are the same as without a thread.
    """

    def __init__(self, make: Callable[[int], Item], stride: int) -> None:
        """Begin with nothing.

        Args:
            make: Returns the item of a number. Always called in the one thread.
            stride: From one number to the next that will be asked for.
        """
        self._make, self._stride = make, stride
        self._next: tuple[int, Future[Item]] | None = None
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="prefetch")
        allowed = torch.get_num_threads()
        self._thread.submit(_compute_with_one_thread).result()
        torch.set_num_threads(allowed)  # the other thread's call changed the whole process

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the thread, at the latest when the item at hand is made."""
        self._thread.shutdown(cancel_futures=True)

    def take(self, number: int) -> Item:
        """The item of that number; the thread begins with the next one.

        Raises:
            Exception: Whatever ``make`` raised.
        """
        if self._next is None or self._next[0] != number:
            self._begin(number)
        assert self._next is not None  # it has begun
        item = self._next[1].result()
        self._begin(number + self._stride)
        return item

    def wait_idle(self) -> None:
        """Wait until the thread is idle, so that the caller may use what ``make`` uses."""
        if self._next is not None:
            wait([self._next[1]])

    def _begin(self, number: int) -> None:
        self._next = number, self._thread.submit(self._make, number)


def _compute_with_one_thread() -> None:
    """Keep torch from starting more threads here: the other cores belong to the training step."""
    torch.set_num_threads(1)
    torch.get_num_threads()  # a thread takes up the process's number when it first asks, and keeps it
