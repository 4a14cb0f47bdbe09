"""Reads project files: the flags of a call as TOML.

::

    mesh = "part.stl"          # a path is relative to this file's folder
    mesh-unit = "mm"
    camera = "camera.json"
    photos = "photos"
    upright = true             # a flag without a value; false leaves it out
    counts = [3, "0-2"]        # a flag with several values
    minutes = 25
"""

from collections.abc import Collection
from pathlib import Path
from typing import Any

from curio_serve import errors as serving
from curio_serve.settings import read_toml, to_arguments

from curio_train.errors import UsageError

FLAG = "--project"


def with_project(arguments: list[str], paths: Collection[str]) -> list[str]:
    """Put the flags of a call's project file, if it names one, before those that were typed; what was typed wins.

    Args:
        arguments: As typed: the world, then flags.
        paths: Names of flags, without dashes, whose values are files or folders.

    Raises:
        UsageError: The file cannot be read, is no TOML, or holds what cannot be a flag.
    """
    arguments = [
        word for typed in arguments for word in (typed.split("=", 1) if typed.startswith(f"{FLAG}=") else [typed])
    ]
    if FLAG not in arguments:
        return arguments
    place = arguments.index(FLAG)
    if place + 1 >= len(arguments):
        raise UsageError(f"{FLAG} stands last, expected a TOML file after it")
    file = Path(arguments[place + 1])
    typed = arguments[:place] + arguments[place + 2 :]
    flags = [word for name, value in _read(file).items() for word in _arguments(name, value, file, paths)]
    return [*typed[:1], *flags, *typed[1:]]


def _read(file: Path) -> dict[str, Any]:
    try:
        content = read_toml(file, FLAG)
    except serving.UsageError as exc:
        raise UsageError(str(exc)) from exc
    if not content:
        raise UsageError(f'{FLAG} {file}: the file is empty, expected flags such as mesh = "part.stl"')
    return content


def _arguments(name: str, value: Any, file: Path, paths: Collection[str]) -> list[str]:
    """Flags and their values; paths count from the file's folder."""
    if name.replace("-", "_") in paths:
        given = value if isinstance(value, list) else [value]
        if all(isinstance(one, str) for one in given):
            value = [str(file.parent / Path(one).expanduser()) for one in given]
    try:
        return to_arguments(name, value, f"{FLAG} {file}", negate=False)
    except serving.UsageError as exc:
        raise UsageError(str(exc)) from exc
