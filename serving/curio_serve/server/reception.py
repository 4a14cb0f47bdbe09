"""Bounds the memory that arriving and waiting messages take, and the time that they may take to arrive.

gRPC tells the length of a message only once it is there. So a call reserves memory for the longest message before it
reads its own, keeps as much as its message takes, and gives that back when it ends. A call without memory waits;
the connection that holds least comes first, and among equals one whose messages have arrived before.

A stream may be idle for long, so it reserves nothing before a message is there. If the whole process takes too much
memory, the streams that are waiting for messages are ended.
"""

import logging
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

import grpc

from curio_serve.api.admission import Place
from curio_serve.errors import CallCancelled
from curio_serve.server import memory
from curio_serve.telemetry import log

_TICK_S = 0.1
# While other calls wait for memory, a message has to arrive within this time.
_HURRIED_S = 1.0
_MOST_PROVEN = 4096


@dataclass(frozen=True)
class ReceptionLimits:
    """Bounds on arriving messages."""

    message_bytes: int = 32 << 20
    """The longest message."""
    held_bytes: int = 256 << 20
    """All messages that arrive or wait; at least one message fits."""
    message_s: float = 10.0
    """Time in which a call's first message has to arrive."""
    idle_s: float = 60.0
    """Time in which a stream's further messages have to arrive."""
    process_bytes: int | None = None
    """Resident memory of the process beyond which streams are ended; None: unbounded."""


@dataclass(eq=False)
class _Arrival:
    """A message that a call waits for, or holds."""

    context: grpc.ServicerContext
    peer: str
    is_stream: bool
    place: Place = field(default_factory=Place)
    """Where its thread sleeps until there is memory."""
    num_bytes: int = 0
    """Memory that it holds or has reserved."""
    limit_s: float = 0.0
    since: float = 0.0
    """When reading began, on the monotonic clock."""
    is_late: bool = False


class Reception:
    """Receives the messages of all calls within limits."""

    def __init__(self, limits: ReceptionLimits) -> None:
        """Nothing is watched before :meth:`start`."""
        self._limits = limits
        self._lock = threading.Lock()
        self._free = max(limits.held_bytes, limits.message_bytes)
        self._held: Counter[str] = Counter()  # bytes of each connection
        self._proven: dict[str, None] = {}  # connections whose messages have arrived, oldest first
        self._waiting: list[_Arrival] = []
        self._arriving: set[_Arrival] = set()
        self._stopped = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="curio-reception", daemon=True)

    def start(self) -> None:
        """Begin to end calls whose messages do not arrive."""
        self._watcher.start()

    def stop(self) -> None:
        """Stop that."""
        self._stopped.set()
        self._watcher.join()

    def receive(self, messages: Iterator[bytes], context: grpc.ServicerContext, is_stream: bool) -> Iterator[bytes]:
        """Read a call's messages.

        Args:
            messages: As gRPC gives them.
            context: Of the call.
            is_stream: Whether further messages may follow the first.

        Yields:
            Each message. Its memory is given back when the next is asked for, or when the iterator is closed.

        Raises:
            CallCancelled: The call ended before its message had arrived.
        """
        arrival = _Arrival(context, context.peer(), is_stream, limit_s=self._limits.message_s)
        try:
            while True:
                yield self._next(arrival, messages)
                self._release(arrival, arrival.num_bytes)
                arrival.limit_s = self._limits.idle_s
        except StopIteration:
            return
        finally:
            self._release(arrival, arrival.num_bytes)

    def _next(self, arrival: _Arrival, messages: Iterator[bytes]) -> bytes:
        if not arrival.is_stream:
            self._reserve(arrival)
        arrival.since = time.monotonic()
        self._arriving.add(arrival)
        try:
            data = next(messages)
        except grpc.RpcError as exc:
            waited = f"did not arrive within {arrival.limit_s:g} s" if arrival.is_late else "had not arrived"
            raise CallCancelled(f"the call was ended because its message {waited}") from exc
        finally:
            self._arriving.discard(arrival)
        self._release(arrival, arrival.num_bytes - len(data))
        if arrival.peer not in self._proven:
            self._prove(arrival.peer)
        return data

    def _prove(self, peer: str) -> None:
        with self._lock:
            if len(self._proven) >= _MOST_PROVEN:
                del self._proven[next(iter(self._proven))]
            self._proven[peer] = None

    def _rank(self, waiting: _Arrival) -> tuple[int, bool]:
        """Sorts the waiting: connections that hold least come first, and among them those that have delivered."""
        return self._held[waiting.peer], waiting.peer not in self._proven

    def _reserve(self, arrival: _Arrival) -> None:
        """Reserve memory for the longest message, if need be after others."""
        with self._lock:
            if not self._waiting and self._free >= self._limits.message_bytes:
                self._grant(arrival)
                return
            self._waiting.append(arrival)
        if not arrival.context.add_callback(arrival.place.wake):
            arrival.place.wake()
        arrival.place.sleep(None)
        with self._lock:
            if arrival not in self._waiting:
                return
            self._waiting.remove(arrival)
        raise CallCancelled("the call ended before there was memory for its message (--message-memory-mb)")

    def _grant(self, arrival: _Arrival) -> None:
        arrival.num_bytes = self._limits.message_bytes
        self._free -= arrival.num_bytes
        self._held[arrival.peer] += arrival.num_bytes

    def _release(self, arrival: _Arrival, num_bytes: int) -> None:
        """Give back that much of an arrival's memory, and let others have it.

        Args:
            arrival: Holds it.
            num_bytes: Negative for a stream's message, which is there before its memory is reserved.
        """
        if not num_bytes:
            return
        with self._lock:
            arrival.num_bytes -= num_bytes
            self._free += num_bytes
            self._held[arrival.peer] -= num_bytes
            if not self._held[arrival.peer]:
                del self._held[arrival.peer]
            while self._waiting and self._free >= self._limits.message_bytes:
                following = min(self._waiting, key=self._rank)
                self._waiting.remove(following)
                self._grant(following)
                following.place.wake()

    def _watch(self) -> None:
        while not self._stopped.wait(_TICK_S):
            now = time.monotonic()
            for arrival in self._arriving.copy():
                limit_s = arrival.limit_s
                if self._waiting and not arrival.is_stream:
                    limit_s = min(limit_s, _HURRIED_S)
                if now - arrival.since > limit_s:
                    self._end(arrival)
            self._relax()

    def _relax(self) -> None:
        """End the waiting streams if the process takes too much memory."""
        most = self._limits.process_bytes
        if most is None or memory.resident_bytes() <= most:
            return
        memory.give_back()
        if memory.resident_bytes() <= most:
            return
        streams = [arrival for arrival in self._arriving.copy() if arrival.is_stream]
        if streams:
            log(logging.WARNING, "streams ended for want of memory", streams=len(streams), limit_mb=most >> 20)
        for arrival in streams:
            self._end(arrival)

    @staticmethod
    def _end(arrival: _Arrival) -> None:
        arrival.is_late = True
        arrival.context.cancel()
