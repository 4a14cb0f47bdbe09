"""Answers the calls that make up the load with as few hand-overs as gRPC allows.

grpcio's own server takes a call through a thread that listens and a thread of a pool that works, with some ten switches
between them, and through half a thousand lines of Python. Around a model that answers in two milliseconds that is a
quarter of the time. Here a few equal threads wait for gRPC's events themselves (leader/followers: Schmidt et al.,
Pattern-Oriented Software Architecture 2, 2000): the one that hears of a message works on it there and then and sends
the answer, while another listens. There is one thread more than there are slots, so one always does, and while all
slots are taken it queues calls, or refuses them before their message is read.

Only the chosen methods come this way; health, reflection, streams and the rest stay with grpcio's server, whose ports,
connections, limits and shutdown they share. Its Python layer offers no such thing, so this stands on the layer below it
(``grpc._cython.cygrpc``), on the same few calls that ``grpc/_server.py`` makes.
"""

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import grpc
from google.protobuf.message import DecodeError, Message
from grpc._cython import cygrpc  # type: ignore[attr-defined]

from curio_serve.admission import Waiter, WorkQueue, hung_up_in_queue, passed_in_queue
from curio_serve.errors import ArgumentError, CurioError, Overloaded, Unavailable
from curio_serve.telemetry import LOGGER
from curio_serve.wire import status_from_error, unreadable

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
        work: WorkQueue,
        methods: Sequence[Method],
        max_calls: int,
        refuse_caller: Callable[[Metadata], CurioError | None],
    ) -> None:
        """Claim the methods; the server must not have been started.

        Args:
            server: Whose ports they are called on.
            work: Slots and queue.
            methods: Not answered by the server itself.
            max_calls: Most open calls, also of those whose message has not come yet.
            refuse_caller: Given a call's metadata, why it may not be made, if so.
        """
        self._server: Any = server._cy_server  # type: ignore[attr-defined]
        self._work, self._methods = work, methods
        self._max_calls, self._refuse_caller = max_calls, refuse_caller
        self._open: set[_Call] = set()
        self.is_stopping, self._all_ended = False, threading.Event()
        self._events = cygrpc.CompletionQueue()
        self._server.register_completion_queue(self._events)
        for method in methods:
            self._server.register_method(method.path)
        num_listeners = work.num_slots + 1
        self._threads = [threading.Thread(target=self._listen, name="curio-direct") for _ in range(num_listeners)]
        # For calls that get the slot of a thread with other duties; see _Call.tell.
        self._spare = ThreadPoolExecutor(work.num_slots, thread_name_prefix="curio-spare")

    def start(self) -> None:
        """Begin to answer; the server must have been started."""
        for method in self._methods:
            for _ in self._threads:
                self._expect(method)
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """End the threads; the server must have been stopped.

        Frames that are worked on are finished first: gRPC ends the process if anything is sent after the shutdown.
        """
        self.is_stopping = True
        if self._open:
            self._all_ended.wait()
        self._events.shutdown()
        for thread in self._threads:
            thread.join()
        self._spare.shutdown()

    def _expect(self, method: Method) -> None:
        """Have gRPC tell of one more call."""
        try:
            self._server.request_registered_call(self._events, self._events, method.path, partial(self._begin, method))
        except ValueError:  # the server is being stopped
            return

    def _listen(self) -> None:
        while True:
            event = self._events.poll()
            if event.completion_type == cygrpc.CompletionType.queue_shutdown:
                return
            try:
                call = event.tag(event)
            except Exception:  # noqa: BLE001 - of a fault of ours a call may die, no thread
                LOGGER.exception("an event could not be handled")
                call = None
            del event  # it keeps its call alive
            if call is not None:
                self.work_on(call)

    def _begin(self, method: Method, event: Any) -> None:
        """A call has come, its message not yet."""
        if not event.success:  # the server is being stopped
            return
        self._expect(method)
        call = _Call(self, method, event.call, event.call_details.deadline)
        self._open.add(call)
        if self.is_stopping:
            self.forget(call)
            return
        if error := self._refuse_caller(event.invocation_metadata):
            call.send_error(error)
            return
        try:
            if len(self._open) > self._max_calls:
                raise Overloaded(f"{self._max_calls} calls are open, which is the limit (--max-calls)", 1.0)
            self._work.promise(call)
        except Overloaded as exc:
            call.refuse(exc)
            return
        event.call.start_server_batch((cygrpc.ReceiveMessageOperation(_NO_FLAGS),), partial(self._received, call))

    def _received(self, call: "_Call", event: Any) -> "_Call | None":
        """A call's message has come; the call, if it has a slot."""
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
        following: Waiter | None = call
        while isinstance(following, _Call):
            begun = time.monotonic()
            try:
                following.answer(begun)
            except Exception:  # noqa: BLE001 - likewise
                LOGGER.exception("a call could not be answered")
                following.drop()
            following = self._work.leave(time.monotonic() - begun)
        if following is not None:
            following.tell()

    def hand_over(self, call: "_Call") -> None:
        """Work on a call that has a slot, on another thread."""
        self._spare.submit(self.work_on, call)

    def withdraw(self, call: "_Call") -> bool:
        """Take a call out of the queue; False if it is not there."""
        return self._work.withdraw(call)

    def forget(self, call: "_Call") -> None:
        """A call has ended."""
        self._open.discard(call)
        if self.is_stopping and not self._open:
            self._all_ended.set()


class _Call:
    """One call, from its beginning to its end."""

    __slots__ = ("_call", "_calls", "_deadline", "_is_watched", "_method", "_since", "data")

    def __init__(self, calls: DirectCalls, method: Method, call: Any, deadline: float) -> None:
        self._calls, self._method, self._call, self._deadline = calls, method, call, deadline
        self._is_watched = False
        self._since = time.monotonic()
        self.data = b""

    def peer(self) -> str:
        address: bytes = self._call.peer()
        return address.decode()

    def tell(self) -> None:
        """It has the slot of a thread that has other things to do."""
        self._calls.hand_over(self)

    def watch(self) -> None:
        """Leave the queue when the client hangs up."""
        self._is_watched = True
        self._call.start_server_batch((cygrpc.ReceiveCloseOnServerOperation(_NO_FLAGS),), self._closed)

    def _closed(self, event: Any) -> None:
        if event.batch_operations[0].cancelled() and self._calls.withdraw(self):
            self._method.refused(self._end_in_queue(), self)
            self._calls.forget(self)

    def _end_in_queue(self) -> CurioError:
        has_passed = time.time() >= self._deadline
        return passed_in_queue(time.monotonic() - self._since) if has_passed else hung_up_in_queue()

    def answer(self, now: float) -> None:
        """Do the work and send what comes of it."""
        if self._calls.is_stopping:
            self.refuse(Unavailable("the server's grace time is over; nothing was done"))
            return
        if time.time() >= self._deadline:
            self.refuse(passed_in_queue(now - self._since))
            return
        kind = self._method.request
        try:
            request = kind.FromString(self.data)
        except DecodeError:
            self.send_error(unreadable(kind, len(self.data)))
            return
        self.data = b""
        answer = self._method.answer(request, self, now - self._since)
        if isinstance(answer, CurioError):
            self.send_error(answer)
            return
        status = cygrpc.SendStatusFromServerOperation(None, _OK, b"", _NO_FLAGS)
        self._send(cygrpc.SendMessageOperation(answer.SerializeToString(), _NO_FLAGS), status)

    def refuse(self, error: CurioError) -> None:
        """End the call without an answer."""
        self._method.refused(error, self)
        self.send_error(error)

    def send_error(self, error: CurioError) -> None:
        """End the call with an error's status."""
        status = status_from_error(error)
        code, details = status.code.value[0], status.details.encode()
        self._send(cygrpc.SendStatusFromServerOperation(status.trailing_metadata, code, details, _NO_FLAGS))

    def drop(self) -> None:
        """End the call in any case."""
        self._calls.forget(self)
        self._call.cancel()

    def _send(self, *operations: Any) -> None:
        operations = (cygrpc.SendInitialMetadataOperation(None, _NO_FLAGS), *operations)
        if not self._is_watched:
            operations += (cygrpc.ReceiveCloseOnServerOperation(_NO_FLAGS),)
        self._call.start_server_batch(operations, self._sent)

    def _sent(self, _event: Any) -> None:
        self._calls.forget(self)
