"""Project files: the flags of a call, written down once as TOML.

::

    mesh = "part.stl"          # a path is relative to this file's folder
    mesh-unit = "mm"
    camera = "camera.json"
    photos = "photos"
    upright = true             # a flag without a value; false leaves it out
    counts = [3, "0-2"]        # a flag with several values
    minutes = 25
"""

import tomllib
from collections.abc import Collection
from pathlib import Path
from typing import Any

from curio_train.errors import UsageError

FLAG = "--project"


def with_project(arguments: list[str], paths: Collection[str]) -> list[str]:
    """A call with the flags of its project file, if it names one, before its own: those win.

    Args:
        arguments: As typed: the world, then flags.
        paths: Names of flags, without dashes, whose values are files or folders.

    Raises:
        UsageError: The file cannot be read, is no TOML, or holds what cannot be a flag.
    """
    if FLAG not in arguments:
        return arguments
    place = arguments.index(FLAG)
    if place + 1 >= len(arguments):
        raise UsageError(f"{FLAG} stands last, expected a TOML file after it")
    file = Path(arguments[place + 1])
    typed = arguments[:place] + arguments[place + 2 :]
    flags = [word for name, value in _read(file).items() for word in _flag(name, value, file, paths)]
    return [*typed[:1], *flags, *typed[1:]]


def _read(file: Path) -> dict[str, Any]:
    try:
        content = tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as exc:
        raise UsageError(f"{FLAG} {file}: cannot be read ({exc.strerror}); expected a TOML file") from exc
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as exc:
        raise UsageError(f"{FLAG} {file}: not TOML ({exc})") from exc
    if not content:
        raise UsageError(f'{FLAG} {file}: the file is empty, expected flags such as mesh = "part.stl"')
    return content


def _flag(name: str, value: object, file: Path, paths: Collection[str]) -> list[str]:
    flag, plain = f"--{name.replace('_', '-')}", name.replace("-", "_")
    if isinstance(value, bool):
        return [flag] if value else []
    values: list[Any] = value if isinstance(value, list) else [value]
    if values and all(isinstance(one, str | int | float) for one in values):
        return [flag, *(str(file.parent / Path(one).expanduser()) if plain in paths else str(one) for one in values)]
    raise UsageError(
        f"{FLAG} {file}, {name}: found a {type(value).__name__}, expected text, a number, a list of them, true or false"
    )
