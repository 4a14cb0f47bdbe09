"""Measures this process's memory, and has freed memory returned to the operating system."""

import mmap
from pathlib import Path

from curio_serve.systems import c_function

_STATM = Path("/proc/self/statm")
# glibc's <malloc.h>
_M_MMAP_THRESHOLD, _M_ARENA_MAX = -3, -8
_LARGE_BYTES, _NUM_ARENAS = 1 << 20, 4


def resident_bytes() -> int:
    """Resident memory of this process in bytes; 0 if the system does not report it."""
    try:
        return int(_STATM.read_text().split()[1]) * mmap.PAGESIZE
    except OSError:
        return 0


def bound_heaps() -> None:
    """Have large buffers returned as soon as they are freed, and keep heaps few, where the C library is glibc.

    By itself glibc learns from the first message of 30 MB to take such buffers from its heaps, of which there are many
    when threads are, and keeps what is freed there.
    """
    mallopt = c_function("mallopt")
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)
        mallopt(_M_ARENA_MAX, _NUM_ARENAS)


def give_back() -> None:
    """Return freed memory, which glibc keeps where it was freed in pieces."""
    trim = c_function("malloc_trim")
    if trim is not None:
        trim(0)
