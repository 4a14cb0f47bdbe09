"""The command ``curio-serve``."""

import logging
import os
import signal
import sys
from dataclasses import replace
from threading import Thread

from curio_serve.errors import CurioError
from curio_serve.server.config import ServeConfig, read_config, to_toml
from curio_serve.systems import STOP_SIGNALS
from curio_serve.telemetry import log, start_logging


def main() -> None:
    """Serve the models of a folder until SIGTERM, SIGHUP or Ctrl-C."""
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
    # Imported here, so that --help need not wait for gRPC and OpenCV.
    from curio_serve.models.hub import fetch, is_on_hub
    from curio_serve.server.server import PoseServer

    lines = start_logging(config.log_level)
    try:
        if is_on_hub(config.models):
            folder = fetch(config.models, lambda line: log(logging.WARNING, "hub is out of reach", reason=line))
            config = replace(config, models=str(folder))
        server = PoseServer(config)
        for number in STOP_SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:  # as nohup sets it
                # From a thread of its own: the one that a signal interrupts may hold the lock that stop() takes.
                signal.signal(number, lambda _number, _frame: Thread(target=server.stop, daemon=True).start())
        address, *metrics = server.start()
        _announce([f"listening on {address}", *(f"metrics on {url}" for url in metrics)])
        server.serve_until_stopped()
    finally:
        lines.stop()


def _announce(lines: list[str]) -> None:
    """Print the addresses; a server whose stdout is a full disk serves all the same."""
    try:
        os.write(sys.stdout.fileno(), "".join(f"{line}\n" for line in lines).encode())
    except OSError as exc:
        log(logging.WARNING, "stdout cannot be written", reason=exc.strerror, lines=lines)
