"""Features that not every operating system has, each with a fallback.

Linux, macOS and Windows differ in more than this package needs; whatever serving and detection use beyond what all of
them have is here, and nowhere else.
"""

import contextlib
import ctypes
import os
import signal
from importlib import import_module
from typing import Any

READ_FLAGS = os.O_RDONLY
"""Flags for ``os.open``: the bytes as they are, not inherited by children, and not waiting for a pipe's writer."""
for _name in ("O_NONBLOCK", "O_CLOEXEC", "O_BINARY"):
    READ_FLAGS |= getattr(os, _name, 0)

APPEND_FLAGS = os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0)
"""Flags for ``os.open``: bytes written go to the end as they are."""

STOP_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGTERM", "SIGINT", "SIGHUP", "SIGBREAK") if hasattr(signal, name)
)
"""The signals that ask a process to end."""


def usable_cores() -> int:
    """The cores of this process's affinity; of the machine where processes have none."""
    affinity = getattr(os, "sched_getaffinity", None)
    return os.cpu_count() or 1 if affinity is None else len(affinity(0))


def lock(descriptor: int) -> bool:
    """Whether no other process has the file locked; it then is until this process closes it.

    Where the system or the file system has no such locks, it counts as free.
    """
    try:
        fcntl: Any = import_module("fcntl")
    except ImportError:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        pass
    return True


def limit_this_process(memory_bytes: int, cpu_s: int) -> None:
    """Bound this process's memory and time, and have it leave no core file, as far as the system does.

    macOS bounds no address space and Windows nothing of this; whoever started the process bounds its time as well.
    """
    try:
        resource: Any = import_module("resource")
    except ImportError:
        return
    for name, limit in (("RLIMIT_AS", memory_bytes), ("RLIMIT_CPU", cpu_s), ("RLIMIT_CORE", 0)):
        hard = limit + (name == "RLIMIT_CPU")  # so that SIGXCPU comes, and not SIGKILL as from outside
        with contextlib.suppress(ValueError, OSError):  # the limit that is there is lower, or cannot be set
            resource.setrlimit(getattr(resource, name), (limit, hard))


def c_function(name: str) -> Any:
    """A function of this process's C library; None if the library has none of this name."""
    try:
        return getattr(ctypes.CDLL(None), name, None)
    except TypeError:  # Windows has no such library
        return None
