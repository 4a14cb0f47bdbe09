"""What the next step needs is made in a thread of its own, while the networks learn from what this step needs."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from types import TracebackType
from typing import Generic, Self, TypeVar

import torch

Item = TypeVar("Item")


class Prefetcher(Generic[Item]):
    """A row of items, made one at a time and at most one ahead of what was taken; the thread ends with the block.

    Items must depend on their number alone: then those taken are the same as without a thread.
    """

    def __init__(self, make: Callable[[int], Item], stride: int) -> None:
        """Begin with nothing.

        Args:
            make: The item of a number. Always called in the one thread.
            stride: From a number to that asked for next.
        """
        self._make, self._stride = make, stride
        self._coming: tuple[int, Future[Item]] | None = None
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="ahead")
        allowed = torch.get_num_threads()
        self._thread.submit(_compute_alone).result()
        torch.set_num_threads(allowed)  # what the other thread set is that of the process, too

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the thread, at the latest when the item at hand is made."""
        self._thread.shutdown(cancel_futures=True)

    def take(self, number: int) -> Item:
        """The item of that number; the next one is begun.

        Raises:
            Exception: Whatever making it raised.
        """
        if self._coming is None or self._coming[0] != number:
            self._begin(number)
        assert self._coming is not None  # it has begun
        item = self._coming[1].result()
        self._begin(number + self._stride)
        return item

    def wait_idle(self) -> None:
        """Wait until the thread rests, so that the caller is alone with what items are made with."""
        if self._coming is not None:
            wait([self._coming[1]])

    def _begin(self, number: int) -> None:
        self._coming = number, self._thread.submit(self._make, number)


def _compute_alone() -> None:
    """Use no more than this thread to compute with: the other cores are the learning's."""
    torch.set_num_threads(1)
    torch.get_num_threads()  # a thread takes up the process's number when it first asks, and keeps it
