"""Answers the calls that make up the load with as few hand-overs as gRPC allows.

grpcio's own server takes a call through a thread that listens and a thread of a pool that works, with some ten switches
between them, and through half a thousand lines of Python. Around a model that answers in two milliseconds that is a
quarter of the time. Here the thread that hears of a message works on it there and then and sends the answer; whoever
finds all slots taken queues the call, or refuses it before its message is read (:mod:`curio_serve.server.listeners`).

Only the chosen methods come this way; health, reflection, streams and the rest stay with grpcio's server, whose ports,
connections, limits and shutdown they share. Its Python layer offers no such thing, so this stands on the layer below it
(``grpc._cython.cygrpc``), on the same few calls that ``grpc/_server.py`` makes.

A call whose handling fails by a fault of ours ends.
"""

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Protocol

import grpc
from google.protobuf.message import DecodeError, Message
from grpc._cython import cygrpc  # type: ignore[attr-defined]

from curio_serve.api.messages import status_from_error, unreadable
from curio_serve.errors import ArgumentError, CurioError, Overloaded, Unavailable
from curio_serve.server.admission import WorkQueue, hung_up_in_queue, passed_in_queue
from curio_serve.server.events import Events, Handler
from curio_serve.server.listeners import Listeners
from curio_serve.telemetry import LOGGER

Metadata = Sequence[tuple[str, str | bytes]]
_NO_FLAGS = 0
_OK = 0


class Caller(Protocol):
    """Who called."""

    def peer(self) -> str:
        """Address, as gRPC writes it."""


@dataclass(frozen=True)
class Method:
    """How the calls of one method with one message each way are answered.

    Attributes:
        path: As gRPC knows it: ``/package.Service/Method``.
        request: Type of its message.
        answer: Called with the message, who sent it and the seconds it waited, on a thread that holds a slot.
        refused: Told of calls that end without having been answered.
    """

    path: str
    request: type[Message]
    answer: Callable[[Any, Caller, float], Message | CurioError]
    refused: Callable[[CurioError, Caller], None]


class DirectCalls:
    """Answers some methods of a server on threads that listen to gRPC themselves."""

    def __init__(
        self,
        server: grpc.Server,
        events: Events,
        work: WorkQueue,
        methods: Sequence[Method],
        max_calls: int,
        refuse_caller: Callable[[Metadata], CurioError | None],
    ) -> None:
        """Claim the methods; the server must not have been started.

        Args:
            server: Whose ports they are called on.
            events: The server's.
            work: Slots and queue.
            methods: Not answered by the server itself.
            max_calls: Most open calls, also of those whose message has not come yet.
            refuse_caller: Given a call's metadata, why it may not be made, if so.
        """
        self._server: Any = server._cy_server  # type: ignore[attr-defined]
        self._events, self._work = events, work
        self._begun = {method.path: Handler(self._begin, method) for method in methods}
        self._max_calls, self._refuse_caller = max_calls, refuse_caller
        self._open: set[_Call] = set()
        self.is_stopping, self._all_ended = False, threading.Event()
        for path in self._begun:
            self._server.register_method(path)
        self._listeners = Listeners(events, work, self.work_on, self.hand_over)
        # For calls that get the slot of a thread with other duties; see _Call.tell.
        self._spare = ThreadPoolExecutor(work.num_slots, thread_name_prefix="curio-spare")

    def start(self) -> None:
        """Begin to answer; the server must have been started."""
        for path in self._begun:
            for _ in range(self._work.num_slots + 1):
                self._expect(path)
        self._listeners.start()

    def stop(self) -> None:
        """End the threads; the server must have been stopped.

        Frames that are worked on are finished first: gRPC ends the process if anything is sent after the shutdown.
        """
        self.is_stopping = True
        if self._open:
            self._all_ended.wait()
        self._listeners.stop()
        self._spare.shutdown()

    def _expect(self, path: str) -> None:
        """Have gRPC tell of one more call."""
        try:
            self._server.request_registered_call(self._events, self._events, path, self._begun[path])
        except ValueError:  # the server is being stopped
            return

    def _begin(self, method: Method, event: Any) -> None:
        """A call has come, its message not yet."""
        if not event.success:  # the server is being stopped
            return
        self._expect(method.path)
        with _Call(self, method, event.call, event.call_details.deadline) as call:
            self._open.add(call)
            self._admit(call, event)

    def _admit(self, call: "_Call", event: Any) -> None:
        """Ask for a call's message, if there may be a place for it."""
        if self.is_stopping:
            self.forget(call)
            return
        if error := self._refuse_caller(event.invocation_metadata):
            call.send_error(error)
            return
        try:
            if len(self._open) > self._max_calls:
                raise Overloaded(f"{self._max_calls} calls are open, which is the limit (--max-calls)", 1.0)
            self._work.promise(call, event.call_details.deadline - time.time())
        except Overloaded as exc:
            call.refuse(exc)
            return
        event.call.start_server_batch((cygrpc.ReceiveMessageOperation(_NO_FLAGS),), Handler(self._received, call))

    def _received(self, call: "_Call", event: Any) -> "_Call | None":
        """A call's message has come; the call, if it has a slot."""
        with call:
            data = event.batch_operations[0].message()
            if data is None:
                self._work.withdraw(call)
                call.refuse(ArgumentError("the call ended before its message had come; expected one message"))
                return None
            call.data = data
            # To hear of its end costs a call more than it saves where its turn comes soon.
            if self._work.is_long:
                call.watch()
            try:
                return call if self._work.enter(call) else None
            except Overloaded as exc:
                call.refuse(exc)
                return None

    def work_on(self, call: "_Call") -> None:
        """Answer a call that has a slot, then those that get the slot after it."""
        following: _Call | None = call
        since = time.monotonic()
        while following is not None:
            self._listeners.watch_out()
            following = self._finish(following, since)
            since = time.monotonic()  # what is heard now keeps the slot from working, too
            following = self._listeners.look_up(following)

    def _finish(self, call: "_Call", since: float) -> "_Call | None":
        """Answer a call and hand its slot on; the call that has it now, if this thread can work on that.

        Args:
            call: Has a slot.
            since: When this thread had done with the call before.
        """
        is_answered = has_worked = False
        try:
            has_worked = call.answer(time.monotonic())
            is_answered = True
        finally:
            if not is_answered:
                call.break_off()
            following = self._work.leave(time.monotonic() - since if has_worked else None)
            if following is not None and not (is_answered and isinstance(following, _Call)):
                following.tell()
                following = None
        return following if isinstance(following, _Call) else None

    def hand_over(self, call: "_Call") -> None:
        """Work on a call that has a slot, on another thread."""
        self._spare.submit(self.work_on, call).add_done_callback(_log_fault)

    def withdraw(self, call: "_Call") -> bool:
        """Take a call out of the queue; False if it is not there."""
        return self._work.withdraw(call)

    def forget(self, call: "_Call") -> None:
        """A call has ended."""
        self._open.discard(call)
        if self.is_stopping and not self._open:
            self._all_ended.set()


def _log_fault(future: Future[None]) -> None:
    if error := future.exception():
        LOGGER.error("a call could not be answered", exc_info=error)


class _Call:
    """One call, from its beginning to its end."""

    __slots__ = ("_call", "_calls", "_deadline", "_is_watched", "_method", "_since", "data")

    def __init__(self, calls: DirectCalls, method: Method, call: Any, deadline: float) -> None:
        self._calls, self._method, self._call, self._deadline = calls, method, call, deadline
        self._is_watched = False
        self._since = time.monotonic()
        self.data = b""

    def __enter__(self) -> "_Call":
        return self

    def __exit__(self, kind: type[BaseException] | None, _error: object, _traceback: TracebackType | None) -> None:
        if kind is not None:
            self.break_off()

    def break_off(self) -> None:
        """End the call because a fault of ours has come up."""
        self._calls.withdraw(self)
        self._calls.forget(self)
        self._call.cancel()

    def peer(self) -> str:
        address: bytes = self._call.peer()
        return address.decode()

    def tell(self) -> None:
        """It has the slot of a thread that has other things to do."""
        self._calls.hand_over(self)

    def watch(self) -> None:
        """Leave the queue when the client hangs up."""
        self._is_watched = True
        self._call.start_server_batch((cygrpc.ReceiveCloseOnServerOperation(_NO_FLAGS),), Handler(self._closed))

    def _closed(self, event: Any) -> None:
        if event.batch_operations[0].cancelled() and self._calls.withdraw(self):
            self._method.refused(self._end_in_queue(), self)
            self._calls.forget(self)

    def _end_in_queue(self) -> CurioError:
        has_passed = time.time() >= self._deadline
        return passed_in_queue(time.monotonic() - self._since) if has_passed else hung_up_in_queue()

    def answer(self, now: float) -> bool:
        """Do the work and send what comes of it; False if there was no work."""
        if self._calls.is_stopping:
            self.refuse(Unavailable("the server's grace time is over; nothing was done"))
            return False
        if time.time() >= self._deadline:
            self.refuse(passed_in_queue(now - self._since))
            return False
        kind = self._method.request
        try:
            request = kind.FromString(self.data)
        except DecodeError:
            self.send_error(unreadable(kind, len(self.data)))
            return False
        self.data = b""
        answer = self._method.answer(request, self, now - self._since)
        if isinstance(answer, CurioError):
            self.send_error(answer)
            return True
        status = cygrpc.SendStatusFromServerOperation(None, _OK, b"", _NO_FLAGS)
        self._send(cygrpc.SendMessageOperation(answer.SerializeToString(), _NO_FLAGS), status)
        return True

    def refuse(self, error: CurioError) -> None:
        """End the call without an answer."""
        self._method.refused(error, self)
        self.send_error(error)

    def send_error(self, error: CurioError) -> None:
        """End the call with an error's status."""
        status = status_from_error(error)
        code, details = status.code.value[0], status.details.encode()
        self._send(cygrpc.SendStatusFromServerOperation(status.trailing_metadata, code, details, _NO_FLAGS))

    def _send(self, *operations: Any) -> None:
        operations = (cygrpc.SendInitialMetadataOperation(None, _NO_FLAGS), *operations)
        if not self._is_watched:
            operations += (cygrpc.ReceiveCloseOnServerOperation(_NO_FLAGS),)
        self._call.start_server_batch(operations, Handler(self._sent))

    def _sent(self, _event: Any) -> None:
        self._calls.forget(self)
