"""Command lines as dataclasses, and their help."""

import argparse
import inspect
import os
import sys
import types
from collections.abc import Iterable, Sequence
from typing import Annotated, Any, TypeVar, Union, get_args

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from curio_serve.version import answer_version

C = TypeVar("C")

HELP_ALL = "--help-all"
"""Shows every flag; the same as --help for commands whose help has one length."""

_HELP = frozenset(("-h", "--help", HELP_ALL))
_REGISTRY = ConstructorRegistry()


@_REGISTRY.primitive_rule
def _optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Show a flag that may be left out as PATH, where tyro by itself shows {None}|PATH."""
    kinds = [kind for kind in get_args(info.type) if kind is not type(None)]
    if info.type_origin not in (Union, types.UnionType) or len(kinds) != 1 or len(get_args(info.type)) != 2:
        return None
    marked: Any = Annotated[(kinds[0], *info.markers)] if info.markers else kinds[0]
    inner = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(marked, set()))
    if not isinstance(inner, PrimitiveConstructorSpec) or inner.nargs != 1:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=inner.metavar,
        instance_from_str=lambda typed: None if typed == ["None"] else inner.instance_from_str(typed),
        is_instance=lambda value: value is None or inner.is_instance(value),
        str_from_instance=lambda value: ["None"] if value is None else inner.str_from_instance(value),
        choices=inner.choices,
    )


def parsed(
    command: type[C], arguments: Sequence[str] | None, prog: str, lists: Sequence[str] = (), **options: Any
) -> C:
    """A command line as a dataclass.

    Args:
        command: Its fields are the arguments.
        arguments: None: those of this process.
        prog: Name of the command, for its help.
        lists: See :func:`with_lists_joined`.
        options: More of ``tyro.cli``'s, such as ``default`` and ``description``.

    Raises:
        SystemExit: Help or version was printed, or the call is wrong.
    """
    given = sys.argv[1:] if arguments is None else list(arguments)
    answer_version(prog, given)
    if _HELP & set(given):
        join_help_lines([command])
        given = ["--help" if word == HELP_ALL else word for word in given]
    try:
        with _REGISTRY:
            return tyro.cli(command, args=with_lists_joined(given, lists), prog=prog, **options)
    except BrokenPipeError:
        stop_printing()
        sys.exit(1)


def stop_printing() -> None:
    """Let nothing more be written to standard output: its reader (``head``, ``less``) has seen enough.

    Python's own flush at exit must not fail on it again.
    """
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def with_lists_joined(given: Sequence[str], lists: Sequence[str]) -> list[str]:
    """Arguments in which no flag of several values is there twice, such flags last; tyro would keep the last alone.

    Args:
        given: As typed: ``--mesh a --mesh b`` as well as ``--mesh a b``.
        lists: The flags, with their dashes.

    Raises:
        SystemExit: Such a flag has no value.
    """
    repeated = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for flag in lists:
        repeated.add_argument(flag, dest=flag, nargs="*", action="extend")
    values, others = repeated.parse_known_args(given)
    if empty := next((flag for flag, typed in vars(values).items() if typed == []), None):
        repeated.exit(2, f"error: {empty}: found no value, expected one or several\n")
    return [*others, *(word for flag, typed in vars(values).items() if typed is not None for word in (flag, *typed))]


def join_help_lines(kinds: Iterable[type]) -> None:
    """Append an ``Attributes:`` block to the docstrings of dataclasses that have none.

    tyro shows the strings under fields as they stand in the source, line breaks included; lines of a block it joins.
    """
    from docstring_parser import parse_from_object

    for kind in kinds:
        if "Attributes:" in (kind.__doc__ or ""):
            continue
        fields = [
            f"    {field.arg_name}: {' '.join(field.description.split())}"
            for field in parse_from_object(kind).params
            if field.description
        ]
        if fields:
            kind.__doc__ = "\n".join([inspect.cleandoc(kind.__doc__ or ""), "", "Attributes:", *fields])
