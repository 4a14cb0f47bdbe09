"""Admission control: a fixed number of slots behind a bounded queue.

Cores are scarce, so a call takes a slot before it decodes or runs a network (work that releases the interpreter's
lock) and gives it back afterwards; the call that has waited longest gets it next. A call that finds the queue full, or
whose deadline would pass before its turn, is refused at once: an answer that comes too late costs everyone.
"""

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from curio_serve.errors import CallCancelled, DeadlineError, Overloaded
from curio_serve.telemetry import Metrics

# The estimated wait is multiplied by this. Without it, a fifth or more of the answered calls are late.
_WAIT_MARGIN = 1.5
_FULL = "which is the limit (--workers, --queue)"
_TOO_LATE = "which takes longer than the call's deadline leaves"


class Call(Protocol):
    """The part of gRPC's servicer context that admission needs."""

    def time_remaining(self) -> float | None:
        """Seconds until the caller's deadline; None without one."""

    def add_callback(self, callback: Callable[[], None]) -> bool:
        """Have a function called when the call ends; False if it has ended already."""


class _Waiter:
    """A thread that waits until it gets a slot or its call ends."""

    def __init__(self) -> None:
        self._wakes: queue.SimpleQueue[None] = queue.SimpleQueue()  # a quarter of an Event's cost

    def wake(self) -> None:
        self._wakes.put(None)

    def sleep(self, limit_s: float | None) -> bool:
        """Wait to be woken; False if the limit passed first."""
        try:
            self._wakes.get(timeout=limit_s)
        except queue.Empty:
            return False
        return True


class WorkQueue:
    """Slots and the queue in front of them, first come, first served."""

    def __init__(self, num_slots: int, max_waiting: int, metrics: Metrics) -> None:
        """Begin with all slots free.

        Args:
            num_slots: Calls that may work at the same time.
            max_waiting: Calls that may wait.
            metrics: Shows both numbers.
        """
        self.num_slots = num_slots
        self._max_waiting = max_waiting
        self._lock = threading.Lock()
        self._num_free = num_slots
        self._waiting: deque[_Waiter] = deque()
        self._mean_work_s = 0.005
        metrics.waiting.set_function(lambda: len(self._waiting))
        metrics.working.set_function(lambda: num_slots - self._num_free)

    @contextmanager
    def slot(self, call: Call, *, always: bool = False) -> Iterator[float]:
        """Hold a slot while working on this thread; yields the seconds the call waited for it.

        Args:
            call: Its deadline bounds the wait; if it ends, it leaves the queue.
            always: Wait even behind a full queue, for calls whose number is bounded otherwise.

        Raises:
            Overloaded: The queue is full, or the deadline would pass before the call is answered.
            DeadlineError: The deadline passed before there was a slot.
            CallCancelled: The client hung up before there was a slot.
        """
        remaining_s, begun = call.time_remaining(), time.monotonic()
        waiter = self._enter(remaining_s, always=always)
        if waiter is not None:
            self._wait(waiter, call, remaining_s)
        granted = time.monotonic()
        try:
            if remaining_s is not None and granted - begun >= remaining_s:
                raise _deadline_passed(granted - begun)
            yield granted - begun
        finally:
            self._leave(time.monotonic() - granted)

    def refusal(self) -> Overloaded | None:
        """Why another call would be refused whatever its deadline; None if it may wait."""
        with self._lock:
            is_full = not self._num_free and len(self._waiting) >= self._max_waiting
            return self._overloaded(_FULL) if is_full else None

    def _enter(self, remaining_s: float | None, *, always: bool) -> _Waiter | None:
        """Take a free slot (None) or a place in the queue."""
        with self._lock:
            if self._num_free:
                self._num_free -= 1
                return None
            if not always and (reason := self._why_refused(remaining_s)):
                raise self._overloaded(reason)
            self._waiting.append(waiter := _Waiter())
            return waiter

    def _wait(self, waiter: _Waiter, call: Call, remaining_s: float | None) -> None:
        """Return with a slot, or raise without one."""
        if not call.add_callback(waiter.wake):
            waiter.wake()
        was_woken = waiter.sleep(remaining_s)
        with self._lock:
            if waiter not in self._waiting:
                return  # woken by the slot
            self._waiting.remove(waiter)
        if was_woken:
            raise CallCancelled("the client hung up while the call was in the queue; nothing was done")
        raise _deadline_passed(remaining_s or 0.0)

    def _leave(self, worked_s: float) -> None:
        """Pass the slot to the first in the queue, or free it."""
        with self._lock:
            self._mean_work_s += 0.05 * (worked_s - self._mean_work_s)
            if self._waiting:
                self._waiting.popleft().wake()
            else:
                self._num_free += 1

    def _why_refused(self, remaining_s: float | None) -> str:
        """Why another call cannot be answered in time; empty if it can, as far as can be estimated."""
        num_ahead = len(self._waiting)
        if num_ahead >= self._max_waiting:
            return _FULL
        if not num_ahead or remaining_s is None:
            return ""
        # Twice the mean: one call in a slot has to end, and this call's own work has to be done.
        needed_s = self._mean_work_s * (_WAIT_MARGIN * num_ahead / self.num_slots + 2)
        return _TOO_LATE if needed_s > remaining_s else ""

    def _overloaded(self, reason: str) -> Overloaded:
        num_waiting = len(self._waiting)
        # Two digits are enough, and let one answer be made for many refused calls.
        retry_s = float(f"{self._mean_work_s * (num_waiting + 1) / self.num_slots:.2g}")
        return Overloaded(
            f"{self.num_slots} requests are being worked on and {num_waiting} are waiting, {reason}; "
            f"try again in {retry_s:g} s",
            retry_s,
        )


def _deadline_passed(waited_s: float) -> DeadlineError:
    return DeadlineError(f"the deadline passed after {waited_s:.3g} s in the queue; nothing was done")
