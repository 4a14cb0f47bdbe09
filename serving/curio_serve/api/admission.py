"""Admission control: a fixed number of slots behind a bounded queue.

Cores are scarce, so a call takes one of a few slots before it decodes or infers (work that releases the interpreter's
lock) and frees it afterwards; the call that has waited longest gets it next. A call beyond the queue is refused at
once, before its message is read: an answer that comes too late costs everyone.
"""

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NoReturn
from weakref import WeakKeyDictionary

import grpc

from curio_serve.errors import CallCancelled, DeadlineError, Overloaded
from curio_serve.telemetry import Metrics

_RESERVATION_S = 1.0
# How much longer a call is assumed to wait than the mean says. Without it a fifth or more of the answered calls come
# late; a larger factor only shortens a queue that need not be long to be never empty (docs/experiments/serving.md).
_MARGIN = 1.5
_IS_FULL = "which is the limit (--workers, --queue)"
_COMES_TOO_LATE = "which takes longer than the call's deadline leaves"


class QueueEntry:
    """A call in the queue; its thread sleeps on it until the call gets a slot or ends."""

    def __init__(self) -> None:
        self._wakes: queue.SimpleQueue[None] = queue.SimpleQueue()  # a quarter of an Event's cost

    def wake(self) -> None:
        """Wake the thread that sleeps here."""
        self._wakes.put(None)

    def sleep(self, limit_s: float | None) -> bool:
        """Sleep until woken; False if the limit passed first."""
        # A call without a deadline has centuries left, which gRPC says in seconds and no lock accepts.
        if limit_s is not None and limit_s > threading.TIMEOUT_MAX:
            limit_s = None
        try:
            self._wakes.get(timeout=limit_s)
        except queue.Empty:
            return False
        return True


class _Sleeper:
    """What the end of a call wakes: the entry that its thread sleeps on at that time."""

    def __init__(self, entry: QueueEntry) -> None:
        self.entry = entry

    def wake(self) -> None:
        self.entry.wake()


class WorkQueue:
    """A fixed number of slots behind a bounded queue, first come, first served."""

    def __init__(
        self, num_slots: int, max_waiting: int, metrics: Metrics, num_behind: Callable[[str], int] = lambda _: 0
    ) -> None:
        """Create an empty queue.

        Args:
            num_slots: Calls that work at the same time.
            max_waiting: Calls that may wait for a slot.
            metrics: Receive both numbers.
            num_behind: Given a connection, how many calls with a reservation a further call of it would overtake.
        """
        self.num_slots = num_slots
        self._max_waiting = max_waiting
        self._num_behind = num_behind
        self._lock = threading.Lock()
        self._num_free = num_slots
        self._waiting: deque[QueueEntry] = deque()
        self._sleepers: WeakKeyDictionary[grpc.ServicerContext, _Sleeper] = WeakKeyDictionary()
        self._reserved: dict[QueueEntry, float] = {}  # since when, oldest first
        self._mean_work_s = 0.005
        metrics.waiting.set_function(lambda: len(self._waiting))
        metrics.working.set_function(lambda: num_slots - self._num_free)

    @contextmanager
    def reserve(self, call: grpc.ServicerContext) -> Iterator[QueueEntry]:
        """Reserve an entry for a call before its message is read: a later refusal would waste the reading.

        A reservation lasts one second, so callers who never send their message do not fill the queue.

        Args:
            call: Its deadline decides whether its turn would come in time.

        Yields:
            The entry, for :meth:`slot`.

        Raises:
            Overloaded: The queue is full, or the deadline would pass before the call is answered.
        """
        remaining_s = call.time_remaining()
        with self._lock:
            if self._why_not(remaining_s):
                self._drop_old_reservations()
                num_behind = min(self._num_behind(call.peer()), len(self._reserved))
                if reason := self._why_not(remaining_s, num_behind):
                    self._refuse(reason)
            entry = QueueEntry()
            self._reserved[entry] = time.monotonic()
        try:
            yield entry
        finally:
            with self._lock:
                self._reserved.pop(entry, None)

    @contextmanager
    def slot(
        self, call: grpc.ServicerContext, entry: QueueEntry | None = None, *, always: bool = False
    ) -> Iterator[float]:
        """Hold a slot while this thread works.

        Args:
            call: Its deadline bounds the wait, and its end takes it out of the queue.
            entry: The one that was reserved for the call, if any.
            always: Wait even behind a full queue, for callers that are bounded otherwise.

        Yields:
            Seconds that the call waited for the slot.

        Raises:
            Overloaded: The queue is full.
            DeadlineError: The deadline passed before there was a slot.
            CallCancelled: The client hung up before there was a slot.
        """
        remaining_s = call.time_remaining()
        begun = time.monotonic()
        entry = entry or QueueEntry()
        if not self._enter(entry, always):
            self._wait(entry, call, remaining_s)
        granted = time.monotonic()
        has_worked = False
        try:
            if remaining_s is not None and granted - begun >= remaining_s:
                raise _deadline_passed(granted - begun)
            has_worked = True
            yield granted - begun
        finally:
            self._leave(time.monotonic() - granted if has_worked else None)

    def _enter(self, entry: QueueEntry, always: bool) -> bool:
        """Take a free slot (True) or join the queue (False)."""
        with self._lock:
            is_reserved = self._reserved.pop(entry, None) is not None
            if self._num_free:
                self._num_free -= 1
                return True
            if len(self._waiting) >= self._max_waiting and not (is_reserved or always):
                self._refuse(_IS_FULL)
            self._waiting.append(entry)
            return False

    def _wait(self, entry: QueueEntry, call: grpc.ServicerContext, remaining_s: float | None) -> None:
        """Return with a slot, or raise without one."""
        # gRPC keeps what is registered until the call ends, and a stream waits for each of its frames.
        if (sleeper := self._sleepers.get(call)) is not None:
            sleeper.entry = entry
            is_active = call.is_active()
        else:
            sleeper = self._sleepers[call] = _Sleeper(entry)
            is_active = call.add_callback(sleeper.wake)
        if not is_active:
            entry.wake()
        is_woken = entry.sleep(remaining_s)
        with self._lock:
            if entry not in self._waiting:
                return  # it was given a slot
            self._waiting.remove(entry)
        if is_woken:
            raise CallCancelled("the client hung up while the call was in the queue; nothing was done")
        raise _deadline_passed(remaining_s or 0.0)

    def _leave(self, worked_s: float | None) -> None:
        """Pass a slot to the first in the queue, or free it.

        Args:
            worked_s: How long the slot was used; None if no work was done.
        """
        with self._lock:
            # A smoothed estimate is enough to judge who would come too late, and when to come back.
            if worked_s is not None:
                self._mean_work_s += 0.05 * (worked_s - self._mean_work_s)
            if self._waiting:
                self._waiting.popleft().wake()
            else:
                self._num_free += 1

    def _why_not(self, remaining_s: float | None, num_behind: int = 0) -> str:
        """The reason why one more call could not be answered in time; empty if it can, as far as is known."""
        num_ahead = len(self._reserved) - num_behind + len(self._waiting) - self._num_free
        if num_ahead >= self._max_waiting:
            return _IS_FULL
        if num_ahead <= 0 or remaining_s is None:
            return ""
        # Twice the work: a running call has to end, and this call's own work has to be done.
        needed_s = self._mean_work_s * (_MARGIN * num_ahead / self.num_slots + 2)
        return _COMES_TOO_LATE if needed_s > remaining_s else ""

    def _drop_old_reservations(self) -> None:
        end = time.monotonic() - _RESERVATION_S
        while self._reserved and self._reserved[first := next(iter(self._reserved))] < end:
            del self._reserved[first]

    def _refuse(self, reason: str) -> NoReturn:
        waiting = len(self._waiting) + len(self._reserved)
        # Two digits are enough, and let the status of a flood's refusals be built once for many.
        retry_s = float(f"{self._mean_work_s * (waiting + 1) / self.num_slots:.2g}")
        raise Overloaded(
            f"{self.num_slots} requests are being worked on and {waiting} are waiting, {reason}; "
            f"try again in {retry_s:g} s",
            retry_s,
        )


def check_is_wanted(call: grpc.ServicerContext) -> None:
    """Check that somebody still waits for a call's answer.

    Raises:
        DeadlineError: Its deadline has passed.
        CallCancelled: The client hung up, or the server's grace time is over.
    """
    remaining_s = call.time_remaining()
    if remaining_s is not None and remaining_s <= 0:
        raise DeadlineError("the deadline passed before the work was done; the rest was not started")
    if not call.is_active():
        raise CallCancelled("the call was ended before the work was done; the rest was not started")


def _deadline_passed(waited_s: float) -> DeadlineError:
    return DeadlineError(f"the deadline passed after {waited_s:.3g} s in the queue; nothing was done")
