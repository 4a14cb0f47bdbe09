"""The bounded queue: refusals, deadlines, calls that hang up, order."""

import math
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import pytest
from curio_serve.api.admission import WorkQueue
from curio_serve.errors import CallCancelled, DeadlineError, Overloaded
from curio_serve.telemetry import Metrics
from prometheus_client import CollectorRegistry


class Caller:
    """A call without gRPC: its deadline, its connection, and a way to hang up."""

    def __init__(self, remaining_s: float | None = None, peer: str = "a") -> None:
        self._remaining_s = remaining_s
        self._peer = peer
        self._callbacks: list[Callable[[], None]] = []
        self._has_ended = False
        self.is_waiting = threading.Event()

    def time_remaining(self) -> float | None:
        return self._remaining_s

    def is_active(self) -> bool:
        return not self._has_ended

    def peer(self) -> str:
        return self._peer

    def add_callback(self, callback: Callable[[], None]) -> bool:
        self._callbacks.append(callback)
        self.is_waiting.set()
        return not self._has_ended

    def hang_up(self) -> None:
        self._has_ended = True
        for callback in self._callbacks:
            callback()


class Bench:
    """A queue, and threads that ask it for slots."""

    def __init__(self, num_slots: int, max_waiting: int) -> None:
        self.queue = WorkQueue(num_slots, max_waiting, Metrics(CollectorRegistry()))
        self.threads = ThreadPoolExecutor(16)
        self.order: list[str] = []

    def hold(
        self, gate: threading.Event, caller: Caller | None = None, *, name: str = "", **options: Any
    ) -> "Future[str]":
        """Take a slot and keep it until the gate opens; returns once it is held or the call waits in the queue."""
        caller, held = caller or Caller(), threading.Event()

        def work() -> str:
            with self.queue.slot(caller, **options):
                self.order.append(name)
                held.set()
                assert gate.wait(30)
            return "done"

        future = self.threads.submit(work)
        future.add_done_callback(lambda _: held.set())
        while not held.is_set() and not caller.is_waiting.is_set():
            held.wait(0.001)
        return future


MakeBench = Callable[[int, int], Bench]


@pytest.fixture
def gate() -> threading.Event:
    return threading.Event()


@pytest.fixture
def make_bench() -> Iterator[MakeBench]:
    made: list[Bench] = []

    def make(num_slots: int, max_waiting: int) -> Bench:
        made.append(Bench(num_slots, max_waiting))
        return made[-1]

    yield make
    for bench in made:
        bench.threads.shutdown()


def test_beyond_the_queue_is_refused_at_once(gate: threading.Event, make_bench: MakeBench) -> None:
    bench = make_bench(1, 2)
    accepted = [bench.hold(gate) for _ in range(3)]
    with pytest.raises(Overloaded, match="1 requests are being worked on and 2 are waiting") as caught:
        bench.hold(gate).result(30)
    assert caught.value.retry_after_s > 0
    # Callers that are bounded otherwise may wait all the same.
    accepted.append(bench.hold(gate, always=True))
    gate.set()
    assert [future.result(30) for future in accepted] == ["done"] * 4
    assert bench.hold(gate).result(30) == "done"


def test_first_come_first_served(gate: threading.Event, make_bench: MakeBench) -> None:
    bench = make_bench(1, 9)
    futures = [bench.hold(gate, name=name) for name in "abcdefg"]
    gate.set()
    assert [future.result(30) for future in futures] == ["done"] * 7
    assert bench.order == list("abcdefg")


def test_all_slots_are_used(gate: threading.Event, make_bench: MakeBench) -> None:
    bench = make_bench(3, 0)
    futures = [bench.hold(gate) for _ in range(3)]
    assert len(bench.order) == 3
    with pytest.raises(Overloaded):
        bench.hold(gate).result(30)
    gate.set()
    assert [future.result(30) for future in futures] == ["done"] * 3


def test_a_deadline_that_passes_in_the_queue_costs_no_work(gate: threading.Event, make_bench: MakeBench) -> None:
    bench = make_bench(1, 5)
    first = bench.hold(gate, name="first")
    with pytest.raises(DeadlineError, match="nothing was done"):
        bench.hold(gate, Caller(0.02), name="late").result(30)
    gate.set()
    assert first.result(30) == "done"
    assert bench.order == ["first"]
    with pytest.raises(DeadlineError):
        bench.hold(gate, Caller(0.0), name="too late at once").result(30)
    assert bench.hold(gate).result(30) == "done"


def test_a_cancelled_call_leaves_the_queue(gate: threading.Event, make_bench: MakeBench) -> None:
    bench, caller = make_bench(1, 1), Caller()
    first = bench.hold(gate, name="first")
    waiting = bench.hold(gate, caller, name="gone")
    caller.hang_up()
    with pytest.raises(CallCancelled):
        waiting.result(30)
    # Its place is free again.
    third = bench.hold(gate, name="third")
    gate.set()
    assert [first.result(30), third.result(30)] == ["done", "done"]
    assert bench.order == ["first", "third"]


def test_a_call_that_ended_before_it_waits_never_works(gate: threading.Event, make_bench: MakeBench) -> None:
    bench, caller = make_bench(1, 1), Caller()
    first = bench.hold(gate)
    caller.hang_up()
    with pytest.raises(CallCancelled):
        bench.hold(gate, caller).result(30)
    gate.set()
    assert first.result(30) == "done"


def _queue(num_slots: int, max_waiting: int) -> WorkQueue:
    return WorkQueue(num_slots, max_waiting, Metrics(CollectorRegistry()))


def _work(monkeypatch: pytest.MonkeyPatch, queue: WorkQueue, seconds: float) -> None:
    """Have a call take this long, on a clock that is ours."""
    now = 0.0
    monkeypatch.setattr("curio_serve.api.admission.time.monotonic", lambda: now)
    for _ in range(200):
        with queue.slot(Caller()):
            now += seconds


@pytest.mark.parametrize("remaining_s", [None, 9.223372035e18, math.inf])
def test_calls_without_a_deadline_wait(gate: threading.Event, make_bench: MakeBench, remaining_s: float | None) -> None:
    bench = make_bench(1, 1)
    first = bench.hold(gate)
    second = bench.hold(gate, Caller(remaining_s))
    gate.set()
    assert [first.result(30), second.result(30)] == ["done", "done"]


def test_a_reservation_keeps_a_place(gate: threading.Event, make_bench: MakeBench) -> None:
    bench = make_bench(1, 1)
    with bench.queue.reserve(Caller()), bench.queue.reserve(Caller()) as second:
        with pytest.raises(Overloaded), bench.queue.reserve(Caller()):
            pass
        working = bench.hold(gate)
        waiting = bench.hold(gate, entry=second)
        with pytest.raises(Overloaded):
            bench.hold(gate).result(30)
        gate.set()
        assert [working.result(30), waiting.result(30)] == ["done", "done"]


def test_a_reservation_given_up_is_free_again() -> None:
    queue = _queue(1, 0)
    for _ in range(3):
        with queue.reserve(Caller()):
            pass
    with queue.slot(Caller()):
        pass


def test_reservations_end(gate: threading.Event, make_bench: MakeBench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Callers who never send their message do not keep others out."""
    bench = make_bench(1, 1)
    with bench.queue.reserve(Caller()) as slow, bench.queue.reserve(Caller()) as slower:
        monkeypatch.setattr("curio_serve.api.admission._RESERVATION_S", 0.0)
        with bench.queue.reserve(Caller()) as quick:
            held = [bench.hold(gate, entry=quick)]
            # Their messages come late; they wait if there is room.
            held.append(bench.hold(gate, entry=slow))
            with pytest.raises(Overloaded):
                bench.hold(gate, entry=slower).result(30)
            gate.set()
            assert [future.result(30) for future in held] == ["done", "done"]


def test_who_would_come_too_late_is_refused_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    queue = _queue(1, 9)
    _work(monkeypatch, queue, 0.1)
    # The slot is free, so nothing says that it cannot be done.
    with queue.reserve(Caller(0.001)), queue.reserve(Caller(math.inf)):
        with (
            pytest.raises(Overloaded, match="2 are waiting, which takes longer than the call's deadline") as caught,
            queue.reserve(Caller(0.3)),
        ):
            pass
        assert caught.value.retry_after_s == pytest.approx(0.3, rel=0.05)
        with queue.reserve(Caller(0.4)), queue.reserve(Caller(None)):
            pass


def test_reserved_calls_that_a_call_overtakes_do_not_refuse_it() -> None:
    queue = WorkQueue(1, 2, Metrics(CollectorRegistry()), {"short": 2, "long": 0}.__getitem__)
    with queue.reserve(Caller(peer="long")), queue.reserve(Caller(peer="long")), queue.reserve(Caller(peer="long")):
        with pytest.raises(Overloaded, match="3 are waiting"), queue.reserve(Caller(peer="long")):
            pass
        with queue.reserve(Caller(peer="short")):
            pass


def test_calls_without_work_do_not_pass_for_quick_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    queue = _queue(1, 9)
    _work(monkeypatch, queue, 0.1)
    for _ in range(200):
        with pytest.raises(DeadlineError), queue.slot(Caller(0.0)):
            pass
    with queue.reserve(Caller()), queue.reserve(Caller()), pytest.raises(Overloaded), queue.reserve(Caller(0.3)):
        pass


def test_errors_of_the_work_give_the_slot_back() -> None:
    queue = _queue(1, 0)
    for _ in range(5):
        with pytest.raises(ValueError, match="mine"), queue.slot(Caller()):
            raise ValueError("mine")


def test_many_threads_leave_nothing_behind() -> None:
    queue, busy, most = _queue(2, 1000), [], []

    def work(number: int) -> None:
        caller = Caller(None if number % 3 else 0.005)
        if number % 5 == 0:
            threading.Timer(0.002, caller.hang_up).start()
        try:
            with queue.slot(caller):
                busy.append(number)
                most.append(len(busy))
                busy.remove(number)
        except (DeadlineError, CallCancelled):
            return

    with ThreadPoolExecutor(32) as threads:
        list(threads.map(work, range(600)))
    assert max(most) <= 2
    with queue.slot(Caller()), queue.slot(Caller()):
        assert busy == []


def test_a_stream_that_waits_for_every_frame_is_registered_once_and_woken_by_its_end() -> None:
    """Until a stream ends gRPC keeps what is registered with it."""
    queue, stream = WorkQueue(1, 8, Metrics(CollectorRegistry())), Caller()

    def work() -> None:
        with queue.slot(stream):
            pass

    with ThreadPoolExecutor(1) as pool:
        for _ in range(3):
            with queue.slot(Caller()):
                waiting = pool.submit(work)
                while not queue._waiting:
                    assert not waiting.done()
            waiting.result(timeout=10)
        with queue.slot(Caller()):
            waiting = pool.submit(work)
            while not queue._waiting:
                assert not waiting.done()
            stream.hang_up()
            with pytest.raises(CallCancelled):
                waiting.result(timeout=10)
    assert len(stream._callbacks) == 1
