"""The memory and the time that arriving messages may take."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import grpc
import pytest
from curio_serve.errors import CallCancelled
from curio_serve.server import reception as module
from curio_serve.server.reception import Reception, ReceptionLimits


class Caller:
    """A call without gRPC: a message that comes when it is sent, and an end."""

    def __init__(self, peer: str = "a") -> None:
        self._peer = peer
        self._sent = threading.Semaphore(0)
        self._messages: list[bytes] = []
        self._callbacks: list[Callable[[], None]] = []
        self.has_ended = threading.Event()
        self.is_waiting, self.is_reading = threading.Event(), threading.Event()

    def peer(self) -> str:
        return self._peer

    def add_callback(self, callback: Callable[[], None]) -> bool:
        self._callbacks.append(callback)
        self.is_waiting.set()
        return not self.has_ended.is_set()

    def cancel(self) -> None:
        self.has_ended.set()
        self._sent.release()
        for callback in self._callbacks:
            callback()

    def send(self, data: bytes) -> None:
        self._messages.append(data)
        self._sent.release()

    def __iter__(self) -> Iterator[bytes]:
        return self

    def __next__(self) -> bytes:
        self.is_reading.set()
        self._sent.acquire()
        if self.has_ended.is_set():
            raise grpc.RpcError
        return self._messages.pop(0)


class Desk:
    """A reception, and threads whose calls it receives."""

    def __init__(self, **limits: Any) -> None:
        values = {"message_bytes": 100, "held_bytes": 200, "message_s": 60.0, "idle_s": 60.0}
        self.reception = Reception(ReceptionLimits(**(values | limits)))
        self.reception.start()
        self._threads = ThreadPoolExecutor(16)
        self.done = threading.Event()

    def call(self, caller: Caller, is_stream: bool = False, done: threading.Event | None = None) -> "Future[bytes]":
        """Receive one message and keep it until the end."""

        def work() -> bytes:
            messages: Any = self.reception.receive(caller, caller, is_stream)  # type: ignore[arg-type]
            try:
                data: bytes = next(messages)
                assert (done or self.done).wait(30)
                return data
            finally:
                messages.close()

        return self._threads.submit(work)

    def know(self, peer: str, length: int) -> None:
        """Receive a message of such a length from a connection, and answer it."""
        caller, answered = Caller(peer), threading.Event()
        answer = self.call(caller, done=answered)
        caller.send(b"x" * length)
        answered.set()
        assert len(answer.result(30)) == length

    def close(self) -> None:
        self.done.set()
        self._threads.shutdown()
        self.reception.stop()


@pytest.fixture
def make_desk() -> Iterator[Callable[..., Desk]]:
    made: list[Desk] = []

    def make(**limits: Any) -> Desk:
        made.append(Desk(**limits))
        return made[-1]

    yield make
    for desk in made:
        desk.close()


def test_a_message_is_read_only_when_there_is_memory(make_desk: Callable[..., Desk]) -> None:
    desk, first, second, third = make_desk(), Caller(), Caller(), Caller()
    released = threading.Event()
    answers = [desk.call(first, done=released), desk.call(second)]
    assert first.is_reading.wait(30)
    assert second.is_reading.wait(30)
    late = desk.call(third)
    assert third.is_waiting.wait(30)
    assert not third.is_reading.is_set()
    # A short message leaves room, but less than the longest message needs.
    first.send(b"short")
    released.set()
    assert answers[0].result(30) == b"short"
    assert third.is_reading.wait(30)
    for caller in (second, third):
        caller.send(b"x" * 100)
    desk.close()
    assert late.result(30) == answers[1].result(30) == b"x" * 100


def test_the_connection_that_holds_least_comes_first(make_desk: Callable[..., Desk]) -> None:
    desk = make_desk()
    desk.know("modest", 100)
    greedy, released = [Caller("greedy") for _ in range(4)], threading.Event()
    calls = []
    for caller in greedy[:2]:
        calls.append(desk.call(caller, done=released))
        assert caller.is_reading.wait(30)
    for caller in greedy[2:]:
        calls.append(desk.call(caller))
        assert caller.is_waiting.wait(30)
    modest = Caller("modest")
    calls.append(desk.call(modest))
    assert modest.is_waiting.wait(30)
    greedy[0].send(b"x" * 100)
    released.set()
    assert modest.is_reading.wait(30)
    assert not greedy[2].is_reading.is_set()
    assert calls[0].result(30)
    for caller in (*greedy, modest):
        caller.cancel()


def test_short_messages_do_not_wait_behind_long_ones(
    make_desk: Callable[..., Desk], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_LONG_BYTES", 10)
    monkeypatch.setattr(module, "_HURRIED_S", 60.0)
    desk = make_desk(held_bytes=400)
    monkeypatch.setattr(module, "_LONG_PART", 2)
    callers = [Caller(f"long {number}") for number in range(3)]
    for caller in callers:
        desk.know(caller.peer(), 100)
    desk.know("short", 5)
    answers = [desk.call(caller) for caller in callers]
    assert all(caller.is_reading.wait(30) for caller in callers[:2])
    assert callers[2].is_waiting.wait(30)
    short, fresh = Caller("short"), Caller("fresh")
    for caller in (short, fresh):
        answers.append(desk.call(caller))
        assert caller.is_reading.wait(30)
    # Half of the memory, which long messages share, is taken; the rest is now, too.
    assert not callers[2].is_reading.is_set()
    assert (desk.reception.num_behind("short"), desk.reception.num_behind("long 0")) == (1, 0)
    last = Caller("short")
    answers.append(desk.call(last))
    assert last.is_waiting.wait(30)
    fresh.cancel()
    assert last.is_reading.wait(30)
    assert not callers[2].is_reading.is_set()
    callers[0].cancel()
    assert callers[2].is_reading.wait(30)
    for caller in (*callers, short, last):
        caller.cancel()
    assert all(answer.exception(30) for answer in answers)


def test_one_long_message_makes_the_next_ones_count_as_long(
    make_desk: Callable[..., Desk], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_LONG_BYTES", 10)
    monkeypatch.setattr(module, "_HURRIED_S", 60.0)
    desk = make_desk(held_bytes=100)
    for length in (100, 5, 5):
        desk.know("both", length)
    desk.know("short", 5)
    blocking, waiting = Caller("other"), Caller("both")
    calls = [desk.call(blocking)]
    assert blocking.is_reading.wait(30)
    calls.append(desk.call(waiting))
    assert waiting.is_waiting.wait(30)
    assert desk.reception.num_behind("short") == 1
    for caller in (blocking, waiting):
        caller.cancel()
    assert all(call.exception(30) for call in calls)


def test_first_messages_that_do_not_come_leave_half_of_the_memory(
    make_desk: Callable[..., Desk], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_HURRIED_S", 60.0)
    desk = make_desk()
    for peer in ("known", "better known"):
        desk.know(peer, 100)
    silent = [Caller(f"silent {number}") for number in range(3)]
    calls = []
    for caller in silent[:2]:
        calls.append(desk.call(caller))
        assert caller.is_reading.wait(30)
    known = [Caller("known"), Caller("better known")]
    for caller in (silent[2], *known):
        calls.append(desk.call(caller))
        assert caller.is_waiting.wait(30)
    silent[0].cancel()
    assert known[0].is_reading.wait(30)
    silent[1].cancel()
    assert silent[2].is_reading.wait(30)
    assert not known[1].is_reading.is_set()
    for caller in (*silent, *known):
        caller.cancel()
    assert all(call.exception(30) for call in calls)


@pytest.mark.parametrize("is_stream", [False, True])
def test_a_message_that_does_not_arrive_ends_its_call(make_desk: Callable[..., Desk], is_stream: bool) -> None:
    caller = Caller()
    with pytest.raises(CallCancelled, match=r"did not arrive within 0\.2 s"):
        make_desk(message_s=0.2).call(caller, is_stream).result(30)
    assert caller.has_ended.is_set()


def test_messages_have_to_hurry_while_others_wait(
    make_desk: Callable[..., Desk], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_HURRIED_S", 0.2)
    desk, slow = make_desk(), [Caller(), Caller()]
    hanging = [desk.call(caller) for caller in slow]
    assert all(caller.is_reading.wait(30) for caller in slow)
    third = Caller("other")
    answer = desk.call(third)
    third.send(b"here")
    desk.done.set()
    assert answer.result(30) == b"here"
    assert any(caller.has_ended.is_set() for caller in slow)
    for caller in slow:
        caller.cancel()
    for call in hanging:
        with pytest.raises(CallCancelled):
            call.result(30)


def test_a_call_that_ends_does_not_wait_for_memory(make_desk: Callable[..., Desk]) -> None:
    desk, first, second, third = make_desk(), Caller(), Caller(), Caller()
    holding = [desk.call(first), desk.call(second)]
    assert first.is_reading.wait(30)
    assert second.is_reading.wait(30)
    waiting = desk.call(third)
    assert third.is_waiting.wait(30)
    third.cancel()
    with pytest.raises(CallCancelled, match="before there was memory"):
        waiting.result(30)
    for caller in (first, second):
        caller.cancel()
    for call in holding:
        with pytest.raises(CallCancelled, match="had not arrived"):
            call.result(30)


def test_streams_end_when_the_process_takes_too_much(
    make_desk: Callable[..., Desk], monkeypatch: pytest.MonkeyPatch
) -> None:
    size = 0
    monkeypatch.setattr(module.memory, "resident_bytes", lambda: size)
    desk, stream, call = make_desk(process_bytes=1000), Caller(), Caller()
    ended, kept = desk.call(stream, is_stream=True), desk.call(call)
    assert stream.is_reading.wait(30)
    assert call.is_reading.wait(30)
    size = 1001
    with pytest.raises(CallCancelled):
        ended.result(30)
    call.send(b"kept")
    desk.done.set()
    assert kept.result(30) == b"kept"
