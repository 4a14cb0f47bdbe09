"""Help texts from the strings under a dataclass's fields, with their lines joined.

tyro shows such strings as they stand in the source, line breaks included; in an ``Attributes:`` block it joins lines.
"""

from collections.abc import Iterable

from docstring_parser import parse_from_object


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
