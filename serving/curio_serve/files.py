"""Reads files that users name, and writes text. What is read may be anything: pipes, devices, huge sparse files."""

import contextlib
import errno
import json
import os
import re
import stat
from pathlib import Path
from typing import Any, TypeAlias

from curio_serve.systems import READ_FLAGS

Place: TypeAlias = tuple[list[Any], str]
"""Of a name among others, see :func:`by_number`."""

_MAX_GIVEN_BYTES = 4 << 20
_NUMBER = re.compile(r"(\d+)")


def by_number(name: str) -> Place:
    """What a name is sorted by: its texts, with the numbers between them as such, and then itself (01 is not 1)."""
    parts: list[Any] = _NUMBER.split(name)
    parts[1::2] = map(int, parts[1::2])
    return parts, name


def read_file(path: str | Path, max_bytes: int) -> bytes:
    """The content of a regular file.

    Args:
        path: The file. A pipe is refused without waiting for its writer.
        max_bytes: Size of the largest file accepted.

    Raises:
        OSError: It cannot be read, is no regular file, or is larger; ``strerror`` says which.
        ValueError: The path has a null byte in it.
    """
    with open(os.open(path, READ_FLAGS), "rb") as file:
        check_regular(os.fstat(file.fileno()), path, max_bytes)
        return file.read(max_bytes)


def read_given(path: str | Path) -> bytes:
    """The content of a small file that a command line names. Pipes are accepted, such as a shell's ``<(...)``.

    Raises:
        OSError: It cannot be read, or is larger than 4 MiB; ``strerror`` says which.
    """
    with open(path, "rb") as file:
        content = file.read(_MAX_GIVEN_BYTES + 1)
    if len(content) > _MAX_GIVEN_BYTES:
        raise OSError(errno.EFBIG, f"more than {_MAX_GIVEN_BYTES} bytes", str(path))
    return content


def read_json(path: str | Path, max_bytes: int) -> Any:
    """The value in a JSON file in UTF-8.

    Raises:
        OSError: As :func:`read_file`.
        ValueError: It is not JSON, or nested more deeply than Python's recursion goes.
    """
    try:
        return json.loads(read_file(path, max_bytes).decode("utf-8"))
    except RecursionError as exc:
        raise ValueError("nested too deeply") from exc


def write_whole(path: Path, text: str) -> None:
    """Write a text file in UTF-8, whole or not at all.

    Raises:
        OSError: It cannot be written; no draft of it is left.
    """
    draft = Path(f"{path}.part")
    try:
        draft.write_text(text, encoding="utf-8")
        os.replace(draft, path)
    except OSError:
        with contextlib.suppress(OSError):
            draft.unlink()
        raise


def direct(path: Path) -> Path:
    """The path without ``..``, so that creating it creates no folder that it only passes through."""
    return Path(os.path.realpath(path.parent), path.name) if ".." in path.parts else path


def check_regular(status: os.stat_result, path: str | Path, max_bytes: int | None = None) -> None:
    """Refuse folders, pipes, devices, and files that are too large.

    Raises:
        OSError: ``strerror`` says why.
    """
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    if max_bytes is not None and status.st_size > max_bytes:
        raise OSError(errno.EFBIG, f"{status.st_size} bytes, at most {max_bytes} are accepted", str(path))
