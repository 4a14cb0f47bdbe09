"""Many images through one function: in parallel, answered in order, with a bounded number in flight."""

import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from queue import SimpleQueue
from typing import Generic, TypeVar

from curio_serve.deferred import DeferredError

Item = TypeVar("Item")
Answer = TypeVar("Answer")

# Enough that one slow image does not idle the other threads, few enough that memory does not notice.
_IN_FLIGHT_A_JOB = 8


def in_order(function: Callable[[Item], Answer], items: Iterable[Item], num_jobs: int) -> Generator[Answer, None, None]:
    """The function's answers in the order of the items; none waits for an item that has not come yet.

    Args:
        function: Called in other threads.
        items: Taken in another thread, never more than a few beyond the next answer; may be endless, or slow to come.
        num_jobs: Threads.

    Raises:
        Exception: What the function or the iterable raised, where its turn comes.
    """
    most = num_jobs * _IN_FLIGHT_A_JOB
    feed = _Feed(function, items, num_jobs, most)
    pending: deque[Future[Answer]] = deque()
    try:
        while feed.take_into(pending):
            # Half of them at a time where there are many: to wake for each answer costs the workers more than the
            # answer's writing.
            count = most // 2 if len(pending) >= most // 2 else 1
            wait([pending[count - 1]])
            for _ in range(count):
                yield pending.popleft().result()
                feed.room.release()
        feed.failed.raise_it()
    finally:
        feed.end()


class _Feed(Generic[Item, Answer]):
    """A thread that takes items and begins their work, as long as there is room for more."""

    def __init__(self, function: Callable[[Item], Answer], items: Iterable[Item], num_jobs: int, most: int) -> None:
        """Begin at once.

        Args:
            function: The work.
            items: What to do it on.
            num_jobs: Threads that do it.
            most: Largest number of items in work or waiting to be taken.
        """
        self.room, self.failed = threading.Semaphore(most), DeferredError()
        self._begun: SimpleQueue[Future[Answer] | None] = SimpleQueue()
        self._has_ended, self._is_done = False, False
        self._pool = ThreadPoolExecutor(num_jobs)
        # A daemon: who waits for a list on standard input that does not end must not keep the process from ending.
        threading.Thread(target=self._run, args=(function, items), name="items", daemon=True).start()

    def take_into(self, pending: "deque[Future[Answer]]") -> bool:
        """Add what was begun meanwhile, in the items' order; wait where there is nothing. False: all items are done."""
        while not self._is_done and (not pending or not self._begun.empty()):
            begun = self._begun.get()
            if begun is None:
                self._is_done = True
            else:
                pending.append(begun)
        return bool(pending)

    def end(self) -> None:
        """Take no further items, and wait for the work that runs."""
        self._has_ended = True
        self.room.release()
        self._pool.shutdown(cancel_futures=True)

    def _run(self, function: Callable[[Item], Answer], items: Iterable[Item]) -> None:
        iterator = iter(items)
        try:
            with self.failed, suppress(StopIteration):
                while self.room.acquire() and not self._has_ended:
                    self._begun.put(self._pool.submit(function, next(iterator)))
        finally:
            self._begun.put(None)
