"""Serves the metrics over HTTP, at one path and within a time limit."""

import os
import socket
import threading
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, generate_latest

_LIMIT_S = 10.0


class MetricsPort(ThreadingHTTPServer):
    """Answers scrapes from :meth:`start` on, each in its own thread."""

    # On Windows this would let two servers have one port.
    allow_reuse_address = os.name == "posix"

    def __init__(self, host: str, port: int, registry: CollectorRegistry) -> None:
        """Open the port.

        Raises:
            OSError: It cannot be opened.
        """
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self.registry = registry
        super().__init__((host, port), _Scrape)

    def start(self) -> None:
        """Start answering."""
        threading.Thread(target=self.serve_forever, name="curio-metrics", daemon=True).start()

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer one connection, which ends at the time limit."""
        limit = threading.Timer(_LIMIT_S, _end, [request])
        limit.daemon = True
        limit.start()
        try:
            super().process_request_thread(request, client_address)
        finally:
            limit.cancel()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore a scrape that broke off; the base class would print a traceback."""


class _Scrape(BaseHTTPRequestHandler):
    server: MetricsPort

    def do_GET(self) -> None:
        """Answer the one path there is."""
        if self.path.partition("?")[0] != "/metrics":
            self.send_error(404)
            return
        content = generate_latest(self.server.registry)
        self.send_response(200)
        self.send_header("Content-Type", CONTENT_TYPE_LATEST)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: Any) -> None:
        """Log nothing: stderr is for JSON lines."""


def _end(connection: socket.socket) -> None:
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)
