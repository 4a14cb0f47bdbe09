"""The help of ``curio-train WORLD``: the flags of everyday use; ``--help-all`` shows every flag."""

import dataclasses
from typing import Any, get_type_hints

from curio_serve.command_line import HELP_ALL, parsed
from docstring_parser import parse_from_object

_RARE = frozenset(
    ("recipe", "network", "labels", "preset", "stop_below", "cache", "checkpoint_minutes", "counts", "up", "lying")
) | {"held_out", "second", "second_background", "blur_px"}
"""Fields that the short help leaves out: hyperparameters, the paper's comparisons, and details of parts on a plane."""


def print_short_help(prog: str, about: str, *parts: Any) -> None:
    """Print the help of everyday flags and end the process.

    Args:
        prog: The command with its world.
        about: What the world is.
        parts: Dataclasses whose fields are the flags, with their defaults as values, in the order of the help.

    Raises:
        SystemExit: Always.
    """
    fields: list[tuple[str, Any, Any]] = []
    lines = []
    for part in parts:
        hints = get_type_hints(type(part), include_extras=True)
        described = parse_from_object(type(part)).params
        texts = {text.arg_name: " ".join((text.description or "").split()) for text in described}
        for field in dataclasses.fields(part):
            if field.name not in _RARE and field.name != "world":
                fields.append((field.name, hints[field.name], dataclasses.field(default=getattr(part, field.name))))
                lines.append(f"    {field.name}: {texts[field.name]}")
    shown = dataclasses.make_dataclass("Shown", fields)
    shown.__doc__ = "\n".join([about, "", "Attributes:", *lines])
    description = f"{about}\n\nThese are the flags of everyday use; {HELP_ALL} shows all, hyperparameters among them."
    parsed(shown, ["--help"], prog, description=description)
