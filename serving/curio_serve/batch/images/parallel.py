"""Many images through one function: in parallel, answered in order, with a bounded number in flight."""

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import TypeVar

from curio_serve.deferred import DeferredError

Item = TypeVar("Item")
Answer = TypeVar("Answer")

# Enough that one slow image does not idle the other threads, few enough that memory does not notice.
_IN_FLIGHT_A_JOB = 8


def in_order(function: Callable[[Item], Answer], items: Iterable[Item], num_jobs: int) -> Generator[Answer, None, None]:
    """The function's answers in the order of the items.

    Args:
        function: Called in other threads.
        items: May be endless; never more than a few beyond the next answer are taken.
        num_jobs: Threads.

    Raises:
        Exception: What the function or the iterable raised, where its turn comes.
    """
    pool = ThreadPoolExecutor(num_jobs)
    pending: deque[Future[Answer]] = deque()
    most = num_jobs * _IN_FLIGHT_A_JOB
    failed = DeferredError()
    try:
        for item in failed.each(items):
            pending.append(pool.submit(function, item))
            if len(pending) >= most:
                # Half of them at a time: to wake for each answer costs the workers more than the answer's writing.
                wait([pending[most // 2 - 1]])
                for _ in range(most // 2):
                    yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
        failed.raise_it()
    finally:
        pool.shutdown(cancel_futures=True)
