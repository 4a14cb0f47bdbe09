"""Threads that wait for gRPC's events and do the work that these bring (leader/followers).

There are as many as calls may be worked on at once, so while one waits there is a core to spare for what it hears.
While all of them work, each looks up between two calls and hears what has come meanwhile: no thread is woken for it,
and the code that answers it is still warm. Only where calls take so long that nobody has looked up for a while, one
more thread listens.

A thread that a fault of ours ends is replaced, and the log says where it failed.
"""

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Generic, TypeVar

from curio_serve.server.admission import WorkQueue
from curio_serve.server.events import AT_ONCE, Events
from curio_serve.telemetry import LOGGER

Call = TypeVar("Call")
_LONG_S = 0.02  # what comes while all work on long calls waits this long at most
_MAX_EVENTS = 64  # between two calls, so that a flood of them leaves time for work


class Listeners(Generic[Call]):
    """Hears events, whose handlers return a call to be worked on, or None.

    Args:
        events: Where they come from.
        work: Slots and queue: there are as many threads as slots.
        work_on: Works on a call; is to call :meth:`watch_out` before and :meth:`look_up` after.
        hand_over: Has another thread work on a call.
    """

    def __init__(
        self,
        events: Events,
        work: WorkQueue,
        work_on: Callable[[Call], None],
        hand_over: Callable[[Call], None],
    ) -> None:
        self._events, self._work = events, work
        self._work_on, self._hand_over = work_on, hand_over
        self._waiting: set[int] = set()  # threads that wait for an event
        self._all_work, self._num_looks = threading.Event(), 0
        self._looking = threading.Lock()  # of two, one would take calls that the other is free for
        self._is_stopping = False
        self._threads = ThreadPoolExecutor(work.num_slots + 1, thread_name_prefix="curio-direct")

    def start(self) -> None:
        """Begin to listen."""
        for _ in range(self._work.num_slots):
            self._keep_up(self._listen)
        self._keep_up(self._relieve)

    def stop(self) -> None:
        """Shut the queue down and wait for the threads to end."""
        self._is_stopping = True
        self._all_work.set()
        self._events.shutdown()
        self._threads.shutdown()

    def watch_out(self) -> None:
        """See to it that someone listens if this takes long; called before working on a call."""
        if not self._waiting and not self._all_work.is_set():
            self._all_work.set()

    def look_up(self, following: Call | None) -> Call | None:
        """Hear what has come while all threads worked.

        While there is no slot to spare, all of it: what is not heard waits inside gRPC or on the wire, where no limit
        of ours holds, and by the time that it is heard nobody wants the answer any more.

        Args:
            following: What this thread goes on with, if it has anything.

        Returns:
            The same, or else what has come.
        """
        if self._waiting or not self._looking.acquire(blocking=False):
            return following
        self._num_looks += 1
        # gRPC also has nothing when it has read a part of a message.
        num_misses_left = 2 if self._work.is_long else 1
        is_over = False
        try:
            for _ in range(_MAX_EVENTS):
                event = self._events.hear(AT_ONCE)
                if event is None:
                    num_misses_left -= 1
                    if not num_misses_left:
                        break
                    continue
                call = event.tag(event)
                del event
                if call is not None and following is None:
                    following = call
                    if not self._work.is_full:
                        break  # who is free hears the rest
                elif call is not None:
                    self._hand_over(call)
                if self._waiting:
                    break
            is_over = True
        finally:
            self._looking.release()
            if not is_over and following is not None:
                self._hand_over(following)
        return following

    def _keep_up(self, duty: Callable[[], None]) -> None:
        """Have a thread do this, and another if a fault of ours ends that one."""

        def ended(future: Future[None]) -> None:
            if error := future.exception():
                LOGGER.error("a thread that answers calls failed; another takes its place", exc_info=error)
                self._keep_up(duty)

        self._threads.submit(duty).add_done_callback(ended)

    def _listen(self) -> None:
        own = threading.get_ident()
        while True:
            self._waiting.add(own)
            event = self._events.hear()
            self._waiting.discard(own)
            if event is None:
                return
            call = event.tag(event)
            del event  # it keeps its call alive
            if call is not None:
                self._work_on(call)

    def _relieve(self) -> None:
        """Listen while all others work on calls that take long."""
        while not self._is_stopping:
            self._all_work.wait()
            num_looks = self._num_looks
            time.sleep(_LONG_S)
            self._all_work.clear()
            self.watch_out()  # after the clearing: who began to work before it has not set it again
            while not (self._waiting or self._is_stopping) and self._num_looks == num_looks:
                self._hear_for(_LONG_S)

    def _hear_for(self, seconds: float) -> None:
        event: Any = self._events.hear(time.time() + seconds)
        if event is None:
            return
        call = event.tag(event)
        if call is not None:
            self._hand_over(call)
