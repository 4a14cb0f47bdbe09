"""Help texts from the strings under a dataclass's fields, with their lines joined.

tyro shows such strings as they stand in the source, line breaks included; in an ``Attributes:`` block it joins lines.
"""

import sys
from collections.abc import Iterable, Sequence
from typing import TypeVar

import tyro
from curio_serve.version import answer_version
from docstring_parser import parse_from_object

C = TypeVar("C")


def parsed(command: type[C], arguments: Sequence[str] | None, prog: str) -> C:
    """A command line as a dataclass.

    Args:
        command: Its fields are the arguments.
        arguments: None: those of this process.
        prog: Name of the command, for its help.
    """
    answer_version(prog, sys.argv[1:] if arguments is None else arguments)
    join_help_lines([command])
    return tyro.cli(command, args=arguments, prog=prog)


def join_help_lines(kinds: Iterable[type]) -> None:
    """Append an ``Attributes:`` block to the docstrings of dataclasses that have none; call it before ``tyro.cli``."""
    for kind in kinds:
        if "Attributes:" in (kind.__doc__ or ""):
            continue
        fields = [
            f"    {field.arg_name}: {' '.join(field.description.split())}"
            for field in parse_from_object(kind).params
            if field.description
        ]
        kind.__doc__ = "\n".join([kind.__doc__ or "", "", "Attributes:", *fields])
