"""Reads files that users name, which may be anything: pipes, devices, sparse files larger than the memory."""

import errno
import os
import stat
from pathlib import Path


def read_file(path: str | Path, max_bytes: int) -> bytes:
    """The content of a regular file.

    Args:
        path: The file. A pipe is refused without waiting for its writer.
        max_bytes: Size of the largest file accepted.

    Raises:
        OSError: It cannot be read, is no regular file, or is larger; ``strerror`` says which.
        ValueError: The path has a null byte in it.
    """
    with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
        check_regular(os.fstat(file.fileno()), path, max_bytes)
        return file.read(max_bytes)


def check_regular(status: os.stat_result, path: str | Path, max_bytes: int | None = None) -> None:
    """Refuse folders, pipes, devices, and files that are too large.

    Raises:
        OSError: ``strerror`` says why.
    """
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    if max_bytes is not None and status.st_size > max_bytes:
        raise OSError(errno.EFBIG, f"{status.st_size} bytes, at most {max_bytes} are accepted", str(path))
