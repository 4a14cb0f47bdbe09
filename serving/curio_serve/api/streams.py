"""Bounds the number of open streams, so that idle ones do not keep others out.

One connection may have a fraction of all streams. Once all are open, a new stream replaces an idle one: of the
connection that has most streams, the one that has waited longest for its next frame. A connection that has as many
streams as the caller's keeps them.
"""

import threading
import time
from functools import partial

import grpc

from curio_serve.errors import Overloaded

# One connection may have this part of the streams, but at least so many.
_FRACTION, _LEAST = 4, 8
# A stream that has waited longer for its next frame counts as idle.
_IDLE_S = 1.0


class Stream:
    """An open stream."""

    def __init__(self, call: grpc.ServicerContext) -> None:
        self.call, self.peer = call, call.peer()
        self._idle_since: float | None = time.monotonic()

    def works(self) -> None:
        """Mark the stream as working on a frame."""
        self._idle_since = None

    def waits(self) -> None:
        """Mark the stream as waiting for a frame."""
        self._idle_since = time.monotonic()

    @property
    def idle_s(self) -> float:
        """Seconds that the stream has waited for a frame."""
        since = self._idle_since
        return 0.0 if since is None else time.monotonic() - since


class Streams:
    """All open streams."""

    def __init__(self, most: int) -> None:
        self._most, self._most_of_peer = most, max(_LEAST, most // _FRACTION)
        self._lock = threading.Lock()
        self._open: dict[str, list[Stream]] = {}  # of each connection
        self.are_ending = False
        """Whether streams end after the frame that they work on."""

    def __len__(self) -> int:
        """Number of open streams."""
        return sum(map(len, list(self._open.values())))

    def open(self, call: grpc.ServicerContext) -> Stream:
        """Open a stream, which is closed when the call ends.

        Raises:
            Overloaded: Too many streams are open.
        """
        stream = Stream(call)
        with self._lock:
            num_own = len(self._open.get(stream.peer, ()))
            if num_own >= self._most_of_peer:
                raise Overloaded(
                    f"{self._most_of_peer} streams of this connection are open, which is the limit of one connection "
                    f"(a part of --max-streams {self._most}); open another connection, or close a stream",
                    1.0,
                )
            replaced = self._replaceable(num_own) if len(self) >= self._most else None
            if replaced:
                self._remove(replaced)
            self._open.setdefault(stream.peer, []).append(stream)
        if replaced:
            replaced.call.cancel()
        if not call.add_callback(partial(self._close, stream)):
            self._close(stream)
        return stream

    def end_idle(self) -> None:
        """Close the streams that wait for a frame, because the server stops."""
        with self._lock:
            idle = [stream for streams in self._open.values() for stream in streams if stream.idle_s > _IDLE_S]
        for stream in idle:
            stream.call.cancel()

    def _replaceable(self, num_own: int) -> Stream:
        """The idle stream that may be closed in favour of a connection with so many streams."""
        found = [
            (len(streams), idle_s, stream)
            for streams in self._open.values()
            for stream in streams
            if len(streams) > num_own and (idle_s := stream.idle_s) > _IDLE_S
        ]
        if not found:
            raise Overloaded(f"{self._most} streams are open, which is the limit (--max-streams)", 1.0)
        return max(found, key=lambda entry: entry[:2])[2]

    def _close(self, stream: Stream) -> None:
        with self._lock:
            self._remove(stream)

    def _remove(self, stream: Stream) -> None:
        streams = self._open.get(stream.peer, [])
        if stream in streams:
            streams.remove(stream)
            if not streams:
                del self._open[stream.peer]
