"""Reads the JSON files beside a model that say something of each of its objects."""

from collections.abc import Iterable, Sequence
from typing import Protocol, TypeVar

from google.protobuf import json_format
from google.protobuf.message import Message

from curio_serve.errors import ModelError


class OfObject(Protocol):
    """What a file says of one object."""

    object: str
    """The object's name."""


M = TypeVar("M", bound=Message)


def parsed_message(text: bytes, empty: M, where: str, writer: str) -> M:
    """The message in a file.

    Args:
        text: Content of the file, JSON.
        empty: A message of the kind that is expected; filled.
        where: The file, for messages.
        writer: What writes such files, for messages.

    Raises:
        ModelError: It is none of that kind.
    """
    try:
        return json_format.Parse(text, empty, ignore_unknown_fields=True, max_recursion_depth=20)
    except (json_format.ParseError, UnicodeDecodeError) as exc:
        raise ModelError(f"{where} is not what {writer} writes: {exc}") from exc


def refuse_other_objects(found: Iterable[OfObject], objects: Sequence[str], where: str, remedy: str) -> None:
    """Refuse a file about other objects than the model's.

    Args:
        found: What it says of each object.
        objects: Names of the model's objects.
        where: The file, for messages.
        remedy: What to do, for messages.

    Raises:
        ModelError: It is about others.
    """
    names = sorted(one.object for one in found)
    if names != sorted(objects):
        raise ModelError(f"{where} is about {names}, the model finds {sorted(objects)}; {remedy}")
