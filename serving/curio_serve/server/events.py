"""gRPC's events, all heard by our own threads.

grpcio's server has a thread of its own that waits for events on a completion queue of its own. Whoever waits on any
queue of a process reads the connections of all, so that thread takes half of what concerns our calls off the wire and
wakes one of ours for it. Here its server gets our queue: our threads alone wait for gRPC, and pass on to grpcio's
thread what is for it.

Stands on the layer below grpcio's public one, ``grpc._cython.cygrpc``.
"""

import queue
import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import grpc
from grpc._cython import cygrpc  # type: ignore[attr-defined]

AT_ONCE = 0.0  # a time that has passed
_ENDS = (cygrpc.CompletionType.queue_timeout, cygrpc.CompletionType.queue_shutdown)


class Handler(partial[Any]):
    """What is called with an event that is ours: the tag of everything that we ask gRPC to do."""

    __slots__ = ()


class Events(cygrpc.CompletionQueue):
    """The one queue of a server's events."""

    def __init__(self) -> None:
        self._others: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def hear(self, until: float | None = None) -> Any | None:
        """Wait for an event of ours.

        Args:
            until: Unix time in seconds; None: without end.

        Returns:
            The event, whose tag is its :class:`Handler`; None where none came, or the queue is shut down.
        """
        while True:
            event = super().poll(until)
            if isinstance(event.tag, Handler):
                return event
            if event.completion_type in _ENDS:
                return None
            self._others.put(event)

    def poll(self, deadline: float | None = None) -> Any:
        """The next event for grpcio's own thread, which calls this."""
        try:
            return self._others.get(timeout=None if deadline is None else max(0.0, deadline - time.time()))
        except queue.Empty:
            return cygrpc.ConnectivityEvent(cygrpc.CompletionType.queue_timeout, False, None)


def share_events(server: grpc.Server, options: Sequence[tuple[str, int]]) -> Events:
    """Give a server that has neither ports nor methods yet a queue that our threads wait on.

    Args:
        server: Made by ``grpc.server``.
        options: Those that it was made with.
    """
    events = Events()
    # Made anew, because a queue that no one waits on would get its share of the connections.
    core = cygrpc.Server(tuple(options), False)
    core.register_completion_queue(events)
    parts: Any = server
    parts._cy_server = parts._state.server = core
    parts._state.completion_queue = events
    return events
