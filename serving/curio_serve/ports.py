"""Whether a page can be served at an address."""

import socket


def port_fault(host: str, port: int) -> str | None:
    """Why a port cannot be listened on, and what to do; None if it is free.

    Viser does not report a port in use; it serves the page at another one.
    """
    try:
        with socket.create_server((host, port)):
            return None
    except (OSError, OverflowError) as exc:
        return f"cannot listen on {host}:{port} ({exc}); choose another --port or --host"
