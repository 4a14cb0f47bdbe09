"""Bounds the memory that arriving and waiting messages take, and the time that they may take to arrive.

gRPC tells the length of a message only once it is there. So a call reserves memory for the longest message before it
reads its own, keeps as much as its message takes, and gives that back when it ends. A call without memory waits; the
connection comes first that would hold least, if its message is as long as its last ones.

Long messages share a fourth of the memory. Each is copied while the interpreter is locked, so with many of them at a
time every other call would wait for seconds; and calls with short messages shall not wait for memory.

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

from curio_serve import memory
from curio_serve.api.admission import QueueEntry
from curio_serve.errors import CallCancelled
from curio_serve.telemetry import log

_TICK_S = 0.1
# While other calls wait for memory, a message has to arrive within this time.
_HURRIED_S = 1.0
_MOST_KNOWN = 4096
# The shortest of the long messages. The first of a connection is taken for so long, and not for a long one.
_LONG_BYTES = 1 << 20
_LONG_PART = 4  # all long messages have a fourth of the memory, but always room for one


@dataclass(frozen=True)
class ReceptionLimits:
    """Bounds on arriving messages."""

    message_bytes: int = 32 << 20
    """The longest message."""
    held_bytes: int = 256 << 20
    """Memory for all messages that arrive or wait; at least one message fits."""
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
    entry: QueueEntry = field(default_factory=QueueEntry)
    """Where its thread sleeps until there is memory."""
    num_bytes: int = 0
    """Memory that it holds or has reserved."""
    claim: int = 0
    """What counts of it when connections are compared: until it has arrived, its expected length."""
    limit_s: float = 0.0
    since: float = 0.0
    """When reading began, on the monotonic clock."""
    is_late: bool = False


class Reception:
    """Receives the messages of all calls within limits."""

    def __init__(self, limits: ReceptionLimits) -> None:
        """Create a reception; :meth:`start` starts its watching thread."""
        self._limits = limits
        self._lock = threading.Lock()
        self._all_bytes = self._free = max(limits.held_bytes, limits.message_bytes)
        self._claims: Counter[str] = Counter()  # bytes of each connection
        self._long_claims = 0  # bytes of long messages
        self._lengths: dict[str, int] = {}  # expected of each connection that has sent a message, oldest first
        self._firsts: set[_Arrival] = set()  # those with memory for the first message of a connection
        self._waiting: list[_Arrival] = []
        self._arriving: set[_Arrival] = set()
        self._stopped = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="curio-reception", daemon=True)

    def start(self) -> None:
        """Begin to end calls whose messages do not arrive."""
        self._watcher.start()

    def stop(self) -> None:
        """Stop ending calls."""
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
        self._release(arrival, arrival.num_bytes - len(data), len(data))
        return data

    def _learn(self, peer: str, length: int) -> None:
        """Record a connection's message length. After a long message, its next short ones count as long, too."""
        if peer not in self._lengths and len(self._lengths) >= _MOST_KNOWN:
            del self._lengths[next(iter(self._lengths))]
        self._lengths[peer] = max(length, self._lengths.get(peer, 0) // 2)

    def _expected(self, peer: str) -> int:
        return self._lengths.get(peer, min(_LONG_BYTES, self._limits.message_bytes))

    def _rank(self, peer: str) -> tuple[bool, int]:
        """Sort key of waiting arrivals; the smallest is served first.

        First messages, which may never come, get one half of the memory before the others, and the rest after them.
        """
        are_many = 2 * len(self._firsts) * self._limits.message_bytes >= self._all_bytes
        return are_many and peer not in self._lengths, self._claims[peer] + self._expected(peer)

    def _may_have(self, peer: str) -> bool:
        expected = self._expected(peer)
        return (
            expected <= _LONG_BYTES
            or not self._long_claims
            or self._long_claims + expected <= self._all_bytes // _LONG_PART
        )

    def num_behind(self, peer: str) -> int:
        """Number of calls waiting for memory that a new call of this connection would overtake."""
        with self._lock:
            rank = self._rank(peer)
            return sum(self._rank(waiting.peer) > rank for waiting in self._waiting)

    def _reserve(self, arrival: _Arrival) -> None:
        """Reserve memory for the longest message, if need be after others."""
        with self._lock:
            if not self._waiting and self._free >= self._limits.message_bytes and self._may_have(arrival.peer):
                self._grant(arrival)
                return
            self._waiting.append(arrival)
            self._hand_out()
        if not arrival.context.add_callback(arrival.entry.wake):
            arrival.entry.wake()
        arrival.entry.sleep(None)
        with self._lock:
            if arrival not in self._waiting:
                return
            self._waiting.remove(arrival)
        raise CallCancelled("the call ended before there was memory for its message (--message-memory-mb)")

    def _hand_out(self) -> None:
        """Give free memory to the waiting arrivals that may have it."""
        while self._waiting and self._free >= self._limits.message_bytes:
            candidates = [waiting for waiting in self._waiting if self._may_have(waiting.peer)]
            if not candidates:
                return
            following = min(candidates, key=lambda waiting: self._rank(waiting.peer))
            self._waiting.remove(following)
            self._grant(following)
            following.entry.wake()

    def _grant(self, arrival: _Arrival) -> None:
        arrival.num_bytes = self._limits.message_bytes
        self._free -= arrival.num_bytes
        if arrival.peer not in self._lengths:
            self._firsts.add(arrival)
        self._claim(arrival, self._expected(arrival.peer))

    def _claim(self, arrival: _Arrival, num_bytes: int) -> None:
        before, arrival.claim = arrival.claim, num_bytes
        if num_bytes > _LONG_BYTES or before > _LONG_BYTES:
            self._long_claims += num_bytes * (num_bytes > _LONG_BYTES) - before * (before > _LONG_BYTES)
        left = self._claims[arrival.peer] + num_bytes - before
        if left:
            self._claims[arrival.peer] = left
        else:
            del self._claims[arrival.peer]

    def _release(self, arrival: _Arrival, num_bytes: int, length: int = 0) -> None:
        """Give back that much of an arrival's memory, and let others have it.

        Args:
            arrival: Holds it.
            num_bytes: Negative for a stream's message, which is there before its memory is reserved.
            length: Of its message, if that has just arrived.
        """
        if not num_bytes and not length:
            return
        with self._lock:
            arrival.num_bytes -= num_bytes
            self._free += num_bytes
            self._claim(arrival, length)
            self._firsts.discard(arrival)
            if length:
                self._learn(arrival.peer, length)
            elif arrival.is_late:
                self._lengths.pop(arrival.peer, None)
            self._hand_out()

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
