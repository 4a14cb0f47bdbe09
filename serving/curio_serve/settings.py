"""Settings from TOML files and environment variables, as command line arguments: one parser then checks all sources."""

import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from curio_serve.errors import UsageError
from curio_serve.files import read_given


def read_toml(path: Path, flag: str) -> dict[str, Any]:
    """The content of a TOML file.

    Args:
        path: The file.
        flag: That names it, for messages.

    Raises:
        UsageError: The file cannot be read, or is not TOML.
    """
    try:
        return tomllib.loads(read_given(path).decode("utf-8"))
    except OSError as exc:
        raise UsageError(f"{flag} {path} cannot be read: {exc.strerror}; expected a TOML file") from exc
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as exc:
        raise UsageError(f"{flag} {path} is not TOML: {exc}") from exc


def to_arguments(name: str, value: Any, source: str, *, negate: bool = True) -> list[str]:
    """One setting as command line arguments.

    Args:
        name: Of the setting, with ``-`` or ``_``.
        value: Text, a number, true or false, or a list of texts and numbers.
        source: Where it comes from, for messages.
        negate: Write false as ``--no-NAME``; else leave it out.

    Raises:
        UsageError: The value is something else.
    """
    flag = name.replace("_", "-")
    if isinstance(value, bool):
        return [f"--{flag}"] if value else [f"--no-{flag}"] if negate else []
    if isinstance(value, str | int | float):
        return [f"--{flag}={value}"]
    if isinstance(value, list) and value and all(isinstance(one, str | int | float) for one in value):
        return [f"--{flag}", *map(str, value)]
    raise UsageError(
        f"{source}, {name}: found a {type(value).__name__}, expected text, a number, a list of them, true or false"
    )


def environment_settings(environment: Mapping[str, str], prefix: str) -> Iterator[tuple[str, str, str]]:
    """The variables that begin with a prefix: (variable, name of the setting, text)."""
    for variable, text in environment.items():
        if variable.startswith(prefix):
            yield variable, variable.removeprefix(prefix).lower(), text
