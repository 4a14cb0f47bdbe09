"""Who may work, who waits, who is sent away.

What is scarce is cores. So a call takes one of a few slots before it decodes or infers (work that leaves the
interpreter's lock), and gives it back after; the one that has waited longest gets it next. A call beyond the queue is
refused at once: an answer that would come too late costs everyone.
"""

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NoReturn, Protocol

from curio_serve.errors import CallCancelled, DeadlineError, Overloaded
from curio_serve.telemetry import Metrics

_PROMISE_S = 1.0
# How much longer a call is taken to wait than the mean says. Without it a fifth or more of the calls that are
# answered come late; more only makes a queue shorter that need not be long to be never empty (docs/experiments.md).
_MARGIN = 1.5
_IS_FULL = "which is the limit (--workers, --queue)"
_COMES_TOO_LATE = "which takes longer than the call's deadline leaves"


class Call(Protocol):
    """What admission needs to know of a call that waits on its own thread; gRPC's servicer context knows it."""

    def time_remaining(self) -> float | None:
        """Seconds until the caller's deadline; None without one."""

    def add_callback(self, callback: Callable[[], None]) -> bool:
        """Have a function called when the call ends; False if it has ended already."""


class Waiter(Protocol):
    """Who waits in the queue."""

    def tell(self) -> None:
        """It has a slot now."""


class _Thread:
    """A thread that waits, until its call is granted a slot or ends."""

    def __init__(self) -> None:
        self._news: queue.SimpleQueue[None] = queue.SimpleQueue()  # a quarter of an Event's cost

    def tell(self) -> None:
        self._news.put(None)

    def is_told_within(self, limit_s: float | None) -> bool:
        try:
            self._news.get(timeout=limit_s)
        except queue.Empty:
            return False
        return True


class WorkQueue:
    """A fixed number of slots behind a bounded queue, first come, first served."""

    def __init__(self, num_slots: int, max_waiting: int, metrics: Metrics) -> None:
        self.num_slots = num_slots
        self._max_waiting = max_waiting
        self._lock = threading.Lock()
        self._num_free = num_slots
        self._waiting: deque[Waiter] = deque()
        self._promised: dict[Waiter, float] = {}  # since when, oldest first
        self._mean_work_s = 0.005
        metrics.waiting.set_function(lambda: len(self._waiting))
        metrics.working.set_function(lambda: num_slots - self._num_free)

    @property
    def is_full(self) -> bool:
        """Whether all slots are taken."""
        return not self._num_free

    @property
    def is_long(self) -> bool:
        """Whether a further call would have to wait for more than one frame."""
        return len(self._waiting) >= self.num_slots

    def promise(self, waiter: Waiter, remaining_s: float) -> None:
        """Keep a place for a call whose message is still on its way: to refuse it later would cost its reading.

        The place is kept for a second, so that callers who never send their message do not fill the queue.

        Args:
            waiter: Of the call.
            remaining_s: Until its deadline; infinite without one.

        Raises:
            Overloaded: There is none, or the deadline would pass before it is answered.
        """
        with self._lock:
            if self._why_not(remaining_s):
                self._drop_old_promises()
                if reason := self._why_not(remaining_s):
                    self._refuse(reason)
            self._promised[waiter] = time.monotonic()

    def enter(self, waiter: Waiter, *, always: bool = False) -> bool:
        """Take a free slot (True) or a place in the queue (False); who waits there is told when it has a slot.

        Args:
            waiter: With or without a promise.
            always: Wait even behind a full queue, for callers that are bounded otherwise.

        Raises:
            Overloaded: The queue is full.
        """
        with self._lock:
            is_promised = self._promised.pop(waiter, None) is not None
            if self._num_free:
                self._num_free -= 1
                return True
            if len(self._waiting) >= self._max_waiting and not (is_promised or always):
                self._refuse(_IS_FULL)
            self._waiting.append(waiter)
            return False

    def withdraw(self, waiter: Waiter) -> bool:
        """Give up a promise or a place in the queue; False if it has neither, but perhaps a slot."""
        with self._lock:
            if self._promised.pop(waiter, None) is not None:
                return True
            try:
                self._waiting.remove(waiter)
            except ValueError:
                return False
            return True

    def leave(self, worked_s: float | None) -> Waiter | None:
        """Hand a slot on to the first in the queue, who is returned and has to be told, or free it.

        Args:
            worked_s: How long the slot was taken; None where there was nothing to do.
        """
        with self._lock:
            # A smoothed guess is enough to tell who would come too late, and when to come back.
            if worked_s is not None:
                self._mean_work_s += 0.05 * (worked_s - self._mean_work_s)
            if self._waiting:
                return self._waiting.popleft()
            self._num_free += 1
            return None

    @contextmanager
    def slot(self, call: Call, *, always: bool = False) -> Iterator[float]:
        """Hold a slot while working on this thread. Gives the seconds it took to get it.

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
        thread = _Thread()
        if not self.enter(thread, always=always):
            self._wait(thread, call, remaining_s)
        granted = time.monotonic()
        try:
            if remaining_s is not None and granted - begun >= remaining_s:
                raise passed_in_queue(granted - begun)
            yield granted - begun
        finally:
            following = self.leave(time.monotonic() - granted)
            if following is not None:
                following.tell()

    def _wait(self, thread: _Thread, call: Call, remaining_s: float | None) -> None:
        """Return with a slot, or raise without one."""
        if not call.add_callback(thread.tell):
            thread.tell()
        is_told = thread.is_told_within(remaining_s)
        if not self.withdraw(thread):
            return
        if is_told:
            raise hung_up_in_queue()
        raise passed_in_queue(remaining_s or 0.0)

    def _why_not(self, remaining_s: float) -> str:
        """Why a further call cannot be answered in time; empty if it can, as far as is known."""
        num_ahead = len(self._promised) + len(self._waiting) - self._num_free
        if num_ahead >= self._max_waiting:
            return _IS_FULL
        if num_ahead <= 0:
            return ""
        # Twice the work: a call that is being worked on has to end, and its own has to be done.
        needed_s = self._mean_work_s * (_MARGIN * num_ahead / self.num_slots + 2)
        return _COMES_TOO_LATE if needed_s > remaining_s else ""

    def _drop_old_promises(self) -> None:
        end = time.monotonic() - _PROMISE_S
        while self._promised and self._promised[first := next(iter(self._promised))] < end:
            del self._promised[first]

    def _refuse(self, reason: str) -> NoReturn:
        waiting = len(self._waiting) + len(self._promised)
        # Two digits say enough, and let the answers to a flood be made once for many.
        retry_s = float(f"{self._mean_work_s * (waiting + 1) / self.num_slots:.2g}")
        raise Overloaded(
            f"{self.num_slots} requests are being worked on and {waiting} are waiting, {reason}; "
            f"try again in {retry_s:g} s",
            retry_s,
        )


def passed_in_queue(waited_s: float) -> DeadlineError:
    """What a call gets whose deadline passed while it waited."""
    return DeadlineError(f"the deadline passed after {waited_s:.3g} s in the queue; nothing was done")


def hung_up_in_queue() -> CallCancelled:
    """What a call gets that ended while it waited."""
    return CallCancelled("the client hung up while the call was in the queue; nothing was done")
