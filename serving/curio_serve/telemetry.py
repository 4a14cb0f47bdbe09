"""Numbers for Prometheus and structured logs.

A log line is one JSON object on stderr. Lines pass through a bounded queue, so a full disk or a stuck pipe costs lines,
never requests. Tokens and image bytes are never handed to the logger.
"""

import json
import logging
import logging.handlers
import queue
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry

LOGGER = logging.getLogger("curio_serve")
_MAX_WAITING_LINES = 10_000
_BUCKETS_S = (0.0005, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128, 0.256, 0.512, 1, 2, 5)


def log(level: int, event: str, **values: Any) -> None:
    """Write one line.

    Args:
        level: Of ``logging``.
        event: What happened, in the same words each time.
        values: What a reader may want to select by, ``request_id`` for one.
    """
    if LOGGER.isEnabledFor(level):
        LOGGER.log(level, event, extra={"values": values})


class JsonFormatter(logging.Formatter):
    """One JSON object a line: time, level, event, and the values given to :func:`log`."""

    def format(self, record: logging.LogRecord) -> str:
        stamp = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
        line = {"time": f"{stamp}.{int(record.msecs):03d}Z", "level": record.levelname.lower()}
        line["event"] = record.getMessage()
        line |= getattr(record, "values", {})
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=False, default=str)


class _DropWhenFull(logging.handlers.QueueHandler):
    def enqueue(self, record: logging.LogRecord) -> None:
        try:
            self.queue.put_nowait(record)
        except queue.Full:
            return


def start_logging(level: str) -> logging.handlers.QueueListener:
    """Send this package's log, and gRPC's, to stderr. ``stop()`` of what is returned writes what still waits."""
    logging.raiseExceptions = False  # a line that cannot be written is lost, not the request
    output = logging.StreamHandler()
    output.setFormatter(JsonFormatter())
    lines: queue.Queue[logging.LogRecord] = queue.Queue(_MAX_WAITING_LINES)
    listener = logging.handlers.QueueListener(lines, output)
    for logger in (LOGGER, logging.getLogger("grpc")):
        logger.handlers = [_DropWhenFull(lines)]
        logger.propagate = False
    LOGGER.setLevel(level.upper())
    listener.start()
    return listener


class Metrics:
    """What the server counts. Names are part of the operator's interface: dashboards and alerts use them."""

    def __init__(self, registry: "CollectorRegistry") -> None:
        from prometheus_client import Counter, Gauge, Histogram

        self.requests = Counter(
            "curio_requests_total", "Calls answered, by method and gRPC status.", ["method", "code"], registry=registry
        )
        self.phases = Histogram(
            "curio_phase_seconds", "Time of a frame in each phase.", ["phase"], registry=registry, buckets=_BUCKETS_S
        )
        self.waiting = Gauge("curio_queue_length", "Requests waiting for a worker.", registry=registry)
        self.working = Gauge("curio_working", "Frames being worked on.", registry=registry)
        self.streams = Gauge("curio_open_streams", "Open DetectStream calls.", registry=registry)
        self.models = Gauge("curio_models_loaded", "Model versions loaded.", registry=registry)
        self.refused_models = Counter(
            "curio_models_refused_total", "Model versions that could not be loaded.", registry=registry
        )
