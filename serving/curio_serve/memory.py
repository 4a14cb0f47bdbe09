"""Measures this process's memory, and says what becomes of freed memory: returned to the operating system, or kept.

Where the C library is not glibc (macOS, Windows, musl), its own rules stay.
"""

import mmap
from pathlib import Path

from curio_serve.systems import c_function

_STATM = Path("/proc/self/statm")
# glibc's <malloc.h>
_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_THRESHOLD, _M_MMAP_MAX, _M_ARENA_MAX = -1, -2, -3, -4, -8
_LARGE_BYTES, _NUM_ARENAS = 1 << 20, 4
_NEVER, _TOP_PAD_BYTES = -1, 256 << 20


def resident_bytes() -> int:
    """Resident memory of this process in bytes; 0 if the system does not report it."""
    try:
        return int(_STATM.read_text().split()[1]) * mmap.PAGESIZE
    except OSError:
        return 0


def bound_heaps() -> None:
    """Have large buffers returned as soon as they are freed, and keep heaps few: for servers.

    By itself glibc learns from the first message of 30 MB to take such buffers from its heaps, of which there are many
    when threads are, and keeps what is freed there.
    """
    mallopt = c_function("mallopt")
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)
        mallopt(_M_ARENA_MAX, _NUM_ARENAS)


def keep_freed() -> None:
    """Have freed memory kept for the next tensors: for training, which frees and allocates the same sizes all the time.

    By itself glibc returns large tensors as soon as they are freed, and each page of the next one is then a fault: most
    of the time of a layer with large feature maps.
    """
    mallopt = c_function("mallopt")
    if mallopt is not None:
        mallopt(_M_MMAP_MAX, 0)  # large blocks are taken from the heap ...
        mallopt(_M_TRIM_THRESHOLD, _NEVER)  # ... whose end is not returned ...
        mallopt(_M_TOP_PAD, _TOP_PAD_BYTES)  # ... and which grows in large steps


def give_back() -> None:
    """Return freed memory, which glibc keeps where it was freed in pieces."""
    trim = c_function("malloc_trim")
    if trim is not None:
        trim(0)
