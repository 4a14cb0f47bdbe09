"""Keeps the numbers for Prometheus and writes structured logs.

A log line is one JSON object on stderr. Lines pass through a bounded queue, so a full disk or a stuck pipe costs lines,
never requests. Tokens and image bytes are never handed to the logger.
"""

import contextlib
import json
import logging
import os
import queue
import threading
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry

LOGGER = logging.getLogger("curio_serve")
_STDERR = 2
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


class LogWriter(logging.Handler):
    """Writes log lines to stderr on a thread of its own.

    It writes past Python's buffers: a thread that is stuck in writing to a full pipe would hold their lock, and the
    process could not end.
    """

    def __init__(self) -> None:
        super().__init__()
        self.setFormatter(JsonFormatter())
        self.addFilter(_is_ours_to_say)
        self._lines: queue.Queue[str | None] = queue.Queue(_MAX_WAITING_LINES)
        self._thread = threading.Thread(target=self._write, name="curio-log", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        """Queue a line, or drop it if the queue is full."""
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait(self.format(record))

    def stop(self, limit_s: float = 2.0) -> None:
        """Write the lines that wait, unless that takes too long."""
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait(None)
        self._thread.join(limit_s)

    def _write(self) -> None:
        while (line := self._lines.get()) is not None:
            with contextlib.suppress(OSError):  # a line that cannot be written is lost, not the request
                os.write(_STDERR, f"{line}\n".encode(errors="replace"))


def _is_ours_to_say(record: logging.LogRecord) -> bool:
    """Whether to keep a log record; drops gRPC's traceback for each client header that is not UTF-8."""
    return not (record.name.startswith("grpc") and record.exc_info and record.exc_info[0] is UnicodeDecodeError)


def start_logging(level: str) -> LogWriter:
    """Send this package's log, and gRPC's, to stderr. ``stop()`` of the result writes the lines that wait."""
    writer = LogWriter()
    for logger in (LOGGER, logging.getLogger("grpc")):
        logger.handlers = [writer]
        logger.propagate = False
    LOGGER.setLevel(level.upper())
    return writer


class Metrics:
    """The server's counters. Their names are part of the operator's interface: dashboards and alerts use them."""

    def __init__(self, registry: "CollectorRegistry") -> None:
        from prometheus_client import Counter, Gauge, Histogram

        self.requests = Counter(
            "curio_requests_total", "Calls answered, by method and gRPC status.", ["method", "code"], registry=registry
        )
        phases = Histogram(
            "curio_phase_seconds", "Time of a frame in each phase.", ["phase"], registry=registry, buckets=_BUCKETS_S
        )
        self.queue_s, self.decode_s, self.inference_s = map(phases.labels, ("queue", "decode", "inference"))
        self.waiting = Gauge("curio_queue_length", "Requests waiting for a worker.", registry=registry)
        self.working = Gauge("curio_working", "Frames being worked on.", registry=registry)
        self.streams = Gauge("curio_open_streams", "Open DetectStream calls.", registry=registry)
        self.models = Gauge("curio_models_loaded", "Model versions loaded.", registry=registry)
        self.refused_models = Counter(
            "curio_models_refused_total", "Model versions that could not be loaded.", registry=registry
        )
