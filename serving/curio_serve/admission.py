"""Who may work, who waits, who is sent away.

Decoding and inference leave the interpreter's lock, so a few threads use all cores; the event loop only moves messages.
A request beyond the queue is refused at once: an answer that would come too late costs everyone.
"""

import asyncio
import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

from curio_serve.errors import DeadlineError, Overloaded
from curio_serve.telemetry import Metrics

T = TypeVar("T")


def num_cores() -> int:
    """Cores this process may use: its affinity, and the quota of its container where it has one (cgroup v2)."""
    cores = len(os.sched_getaffinity(0))
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
    except (OSError, ValueError):
        return cores
    return cores if quota == "max" else max(1, min(cores, round(int(quota) / int(period))))


class WorkQueue:
    """A fixed number of worker threads behind a bounded queue."""

    def __init__(self, num_workers: int, max_waiting: int, metrics: Metrics) -> None:
        self._threads = ThreadPoolExecutor(num_workers, thread_name_prefix="curio-worker")
        self._num_workers, self._max_waiting = num_workers, max_waiting
        self._num_admitted, self._lock = 0, threading.Lock()
        self._mean_work_s = 0.005
        self._metrics = metrics
        metrics.waiting.set_function(lambda: max(0, self._num_admitted - num_workers))
        metrics.working.set_function(lambda: min(self._num_admitted, num_workers))

    async def run(self, work: Callable[[float], T], remaining_s: float | None, *, always: bool = False) -> T:
        """Do the work on a worker thread. Call from the event loop.

        Args:
            work: Gets the seconds it had to wait.
            remaining_s: Time until the caller's deadline; None: no deadline.
            always: Wait even behind a full queue, for callers that are bounded otherwise.

        Raises:
            Overloaded: The queue is full.
            DeadlineError: The deadline passed while the work waited.
            asyncio.CancelledError: The caller hung up; work that had not begun is dropped.
        """
        if self._num_admitted >= self._num_workers + self._max_waiting and not always:
            retry_s = self._mean_work_s * self._max_waiting / self._num_workers
            raise Overloaded(
                f"{self._num_admitted} requests are being worked on or waiting, which is the limit (--workers, "
                f"--queue); try again in {retry_s:.2g} s",
                retry_s,
            )
        admitted = time.monotonic()
        with self._lock:
            self._num_admitted += 1
        future = self._threads.submit(self._work, work, admitted, remaining_s)
        # Runs when the work ends, or at once where a cancelled call leaves the queue before it began.
        future.add_done_callback(self._leave)
        return await asyncio.wrap_future(future)

    def _work(self, work: Callable[[float], T], admitted: float, remaining_s: float | None) -> T:
        begun = time.monotonic()
        waited_s = begun - admitted
        if remaining_s is not None and waited_s >= remaining_s:
            raise DeadlineError(f"the deadline passed after {waited_s:.3g} s in the queue; nothing was done")
        try:
            return work(waited_s)
        finally:
            # A smoothed guess is enough to tell clients when to come back.
            self._mean_work_s += 0.05 * (time.monotonic() - begun - self._mean_work_s)

    def _leave(self, _done: "Future[T]") -> None:
        with self._lock:
            self._num_admitted -= 1

    def close(self) -> None:
        """Drop what waits and let the threads end."""
        self._threads.shutdown(wait=False, cancel_futures=True)
