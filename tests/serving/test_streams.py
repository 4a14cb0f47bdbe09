"""Who gets a stream when all are open."""

from collections.abc import Callable

import pytest
from curio_serve.api import streams as module
from curio_serve.api.streams import Streams
from curio_serve.errors import Overloaded


class Caller:
    """A stream without gRPC."""

    def __init__(self, peer: str) -> None:
        self._peer = peer
        self._callbacks: list[Callable[[], None]] = []
        self.has_ended = False

    def peer(self) -> str:
        return self._peer

    def time_remaining(self) -> float | None:
        return None

    def is_active(self) -> bool:
        return not self.has_ended

    def add_callback(self, callback: Callable[[], None]) -> bool:
        self._callbacks.append(callback)
        return not self.has_ended

    def cancel(self) -> None:
        self.has_ended = True
        for callback in self._callbacks:
            callback()


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Seconds on the clock that streams look at."""
    seconds = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: seconds[0])
    return seconds


def test_an_idle_stream_of_the_connection_with_most_makes_room(now: list[float]) -> None:
    streams, greedy = Streams(4), [Caller("greedy") for _ in range(3)]
    opened = []
    for now[0], caller in enumerate(greedy):
        opened.append(streams.open(caller))
    modest = Caller("modest")
    streams.open(modest)
    opened[0].works()
    now[0] = 10.0
    streams.open(Caller("other"))
    # The first is being worked on; the second has waited longest.
    assert [caller.has_ended for caller in (*greedy, modest)] == [False, True, False, False]
    assert len(streams) == 4
    opened[0].waits()
    with pytest.raises(Overloaded, match="4 streams are open"):
        streams.open(Caller("greedy"))


def test_streams_that_work_keep_their_places(now: list[float]) -> None:
    streams, callers = Streams(2), [Caller("a"), Caller("b")]
    opened = [streams.open(caller) for caller in callers]
    now[0] = 0.5
    with pytest.raises(Overloaded):
        streams.open(Caller("c"))
    opened[0].works()
    opened[1].works()
    now[0] = 100.0
    with pytest.raises(Overloaded):
        streams.open(Caller("c"))
    opened[1].waits()
    with pytest.raises(Overloaded):
        streams.open(Caller("c"))
    now[0] = 102.0
    streams.open(Caller("c"))
    assert [caller.has_ended for caller in callers] == [False, True]


def test_places_of_ended_calls_are_free(now: list[float]) -> None:
    streams, ended = Streams(1), Caller("a")
    ended.cancel()
    streams.open(ended)
    assert len(streams) == 0
    for _ in range(3):
        caller = Caller("a")
        streams.open(caller)
        assert len(streams) == 1
        caller.cancel()
        assert len(streams) == 0
