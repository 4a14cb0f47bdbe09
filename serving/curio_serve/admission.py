"""Who may work, who waits, who is sent away.

Every call has a thread of its own, and a waiting thread costs almost nothing; what is scarce is cores. So a call takes
one of a few slots before it decodes or infers (work that leaves the interpreter's lock), and gives it back after. A
call beyond the queue is refused at once: an answer that would come too late costs everyone.
"""

import os
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn, Protocol

from curio_serve.errors import CallCancelled, DeadlineError, Overloaded
from curio_serve.telemetry import Metrics


class Call(Protocol):
    """What admission needs to know of a call; gRPC's servicer context knows it."""

    def time_remaining(self) -> float | None:
        """Seconds until the caller's deadline; None without one."""

    def add_callback(self, callback: Callable[[], None]) -> bool:
        """Have a function called when the call ends; False if it has ended already."""


def num_cores() -> int:
    """Cores this process may use: its affinity, and the quota of its container where it has one (cgroup v2)."""
    cores = len(os.sched_getaffinity(0))
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
    except (OSError, ValueError):
        return cores
    return cores if quota == "max" else max(1, min(cores, round(int(quota) / int(period))))


class _Waiter:
    """A call in the queue: waiting, until it is granted a slot or leaves."""

    def __init__(self) -> None:
        self.news: queue.SimpleQueue[None] = queue.SimpleQueue()  # a quarter of an Event's cost
        self.is_granted = False

    def tell(self) -> None:
        """Wake it up: it was granted a slot, or its call has ended."""
        self.news.put(None)


class WorkQueue:
    """A fixed number of slots behind a bounded queue, first come, first served."""

    def __init__(self, num_slots: int, max_waiting: int, metrics: Metrics) -> None:
        self._num_slots, self._max_waiting = num_slots, max_waiting
        self._lock = threading.Lock()
        self._num_free = num_slots
        self._waiting: deque[_Waiter] = deque()
        self._mean_work_s = 0.005
        metrics.waiting.set_function(lambda: len(self._waiting))
        metrics.working.set_function(lambda: num_slots - self._num_free)

    @property
    def is_full(self) -> bool:
        """Whether a further call would be refused."""
        return not self._num_free and len(self._waiting) >= self._max_waiting

    def refuse(self) -> NoReturn:
        """Send a call away.

        Raises:
            Overloaded: Says when to come back.
        """
        waiting = len(self._waiting)
        retry_s = self._mean_work_s * (waiting + 1) / self._num_slots
        raise Overloaded(
            f"{self._num_slots} requests are being worked on and {waiting} are waiting, which is the limit "
            f"(--workers, --queue); try again in {retry_s:.2g} s",
            retry_s,
        )

    @contextmanager
    def slot(self, call: Call, *, always: bool = False) -> Iterator[float]:
        """Hold a slot while working. Gives the seconds it took to get it.

        Args:
            call: Its deadline bounds the wait, its end takes it out of the queue.
            always: Wait even behind a full queue, for callers that are bounded otherwise.

        Raises:
            Overloaded: The queue is full.
            DeadlineError: The deadline passed before there was a slot.
            CallCancelled: The client hung up before there was a slot.
        """
        remaining_s = call.time_remaining()
        begun = time.monotonic()
        waiter = self._enter(always)
        if waiter is not None:
            self._wait(waiter, call, remaining_s)
        granted = time.monotonic()
        try:
            if remaining_s is not None and granted - begun >= remaining_s:
                raise DeadlineError(f"the deadline passed after {granted - begun:.3g} s in the queue; nothing was done")
            yield granted - begun
        finally:
            self._leave(time.monotonic() - granted)

    def _enter(self, always: bool) -> _Waiter | None:
        """Take a free slot (None) or a place in the queue."""
        with self._lock:
            if self._num_free:
                self._num_free -= 1
                return None
            if self.is_full and not always:
                self.refuse()
            waiter = _Waiter()
            self._waiting.append(waiter)
            return waiter

    def _wait(self, waiter: _Waiter, call: Call, remaining_s: float | None) -> None:
        """Return with a slot, or raise without one."""
        if not call.add_callback(waiter.tell):
            waiter.tell()
        try:
            waiter.news.get(timeout=remaining_s)
            is_told = True
        except queue.Empty:
            is_told = False
        with self._lock:
            if waiter.is_granted:
                return
            self._waiting.remove(waiter)
        if is_told:
            raise CallCancelled("the client hung up while the call was in the queue; nothing was done")
        raise DeadlineError(f"the deadline passed after {remaining_s:.3g} s in the queue; nothing was done")

    def _leave(self, worked_s: float) -> None:
        """Hand the slot to the first in the queue, or free it."""
        with self._lock:
            # A smoothed guess is enough to tell clients when to come back.
            self._mean_work_s += 0.05 * (worked_s - self._mean_work_s)
            if self._waiting:
                waiter = self._waiting.popleft()
                waiter.is_granted = True
                waiter.tell()
            else:
                self._num_free += 1
