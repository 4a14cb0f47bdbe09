"""Command lines from typed dataclasses, also where torch is barred from being imported."""

import sys
from typing import Any

import tyro


def parse(kind: Any, **options: Any) -> Any:
    """``tyro.cli(kind, **options)``.

    tyro imports torch wherever ``sys.modules`` names it, and it is named, as None, where a process has barred it. The
    entry is put back afterwards.
    """
    barred = "torch" in sys.modules and sys.modules["torch"] is None
    if barred:
        del sys.modules["torch"]
    try:
        return tyro.cli(kind, **options)
    finally:
        if barred:
            sys.modules["torch"] = None  # type: ignore[assignment]
