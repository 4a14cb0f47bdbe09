"""Runs a command: errors become one message on stderr and an exit status, signals stop it."""

import os
import sys
from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from curio_train.errors import CurioError
from curio_train.learning.runs.interruption import Interrupted, Interruption, interruptible

CACHE = Path("~/.cache/curio-pose")
"""Where image sets that a world draws once, and downloads, are kept."""


def answer(work: Callable[[Interruption], int]) -> int:
    """Do a command's work and return its exit status; each deliberate error is one message on stderr."""
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    with interruptible() as interruption:
        try:
            return work(interruption)
        except CurioError as exc:
            console.print("error:", str(exc), style="bold red", markup=False)
            return exc.exit_status
        except Interrupted as exc:
            console.print(f"stopped by {exc}; whatever was saved before is intact", markup=False)
            return exc.exit_status
        except BrokenPipeError:  # the reader of our output (head, less) has seen enough
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 1


def warn(text: str) -> None:
    """Print a warning on stderr."""
    tell(f"warning: {text}")


def tell(text: str) -> None:
    """Print a line on stderr, where progress goes; stdout is for results."""
    print(text, file=sys.stderr)
