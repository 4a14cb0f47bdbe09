"""The command ``curio-serve``."""

import os
import signal
import sys

from curio_serve.errors import CurioError
from curio_serve.server.config import ServeConfig, read_config, to_toml


def main() -> None:
    """Serve the models of a folder until SIGTERM or Ctrl-C."""
    try:
        config = read_config(sys.argv[1:], os.environ)
        if config.dump_config:
            print(to_toml(config), end="")
            return
        _serve(config)
    except CurioError as exc:
        print(f"curio-serve: {exc}", file=sys.stderr)
        sys.exit(exc.exit_status)
    except KeyboardInterrupt:
        # Before the server has taken the signal over there is nothing to drain.
        sys.exit(130)


def _serve(config: ServeConfig) -> None:
    # gRPC's own stderr lines say again, and less clearly, what our messages say.
    os.environ.setdefault("GRPC_VERBOSITY", "NONE")
    # Connections are read by the threads that answer, not by threads of gRPC's own that would wake them.
    os.environ.setdefault("GRPC_EXPERIMENTS", "-event_engine_listener")
    # Imported here, so that --help need not wait for gRPC and OpenCV.
    from curio_serve.server.server import PoseServer
    from curio_serve.telemetry import start_logging

    lines = start_logging(config.log_level)
    try:
        server = PoseServer(config)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda _number, _frame: server.stop())
        address, *metrics = server.start()
        print(f"listening on {address}", flush=True)
        for url in metrics:
            print(f"metrics on {url}", flush=True)
        server.serve_until_stopped()
    finally:
        lines.stop()
