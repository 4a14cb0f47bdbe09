"""Runs a command: errors become one message on stderr and an exit status, signals stop it."""

import sys
from collections.abc import Callable
from pathlib import Path

from curio_serve.command_line import stop_printing
from curio_serve.memory import keep_freed
from rich.console import Console

from curio_train.errors import CurioError, UsageError
from curio_train.learning.runs.interruption import Interrupted, Interruption, interruptible

CACHE = Path("~/.cache/curio-pose")
"""Where image sets that a world draws once, and downloads, are kept."""

_EXTRAS = {"pycolmap": "capture", "viser": "view", "ray": "ray"}
"""Extras by the packages that they alone bring; all others of training are in ``train``."""


def answer(work: Callable[[Interruption], int]) -> int:
    """Do a command's work and return its exit status; each deliberate error is one message on stderr.

    The process keeps the memory that it frees, see :func:`~curio_serve.memory.keep_freed`.
    """
    keep_freed()
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    with interruptible() as interruption:
        try:
            return work(interruption)
        except CurioError as exc:
            console.print("error:", str(exc), style="bold red", markup=False)
            return exc.exit_status
        except ModuleNotFoundError as exc:
            console.print("error:", _missing_extra(exc), style="bold red", markup=False)
            return UsageError.exit_status
        except Interrupted as exc:
            return _stopped(console, exc)
        except BrokenPipeError:
            stop_printing()
            return 1
        except (RuntimeError, TypeError):
            # Libraries written in C++ make errors of their own of what is raised within them.
            if interruption.signum is None:
                raise
            return _stopped(console, Interrupted(interruption.signum))


def _stopped(console: Console, by: Interrupted) -> int:
    console.print(f"stopped by {by}; whatever was saved before is intact", markup=False)
    return by.exit_status


def _missing_extra(exc: ModuleNotFoundError) -> str:
    """Which extra brings a package that is not installed; a missing module of our own is a fault, and raised."""
    package = (exc.name or "").partition(".")[0]
    if not package or package.startswith("curio_"):
        raise exc
    extra = _EXTRAS.get(package, "train")
    return (
        f"this needs the package {package}, which the base install leaves out; install the extra {extra}: "
        f"pip install 'curio-pose[{extra}]' (in a clone: pip install '.[{extra}]')"
    )


def warn(text: str) -> None:
    """Print a warning on stderr."""
    report(f"warning: {text}")


def report(text: str) -> None:
    """Print a line on stderr, where progress goes; stdout is for results."""
    print(text, file=sys.stderr)
