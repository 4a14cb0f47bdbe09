"""What ``curio-detect`` tells on standard error: a bar on a terminal, and what it came to at the end."""

import sys
import time
from typing import Self

from rich.console import Console
from rich.progress import Progress as Bar
from rich.progress import ProgressColumn, SpinnerColumn, Task, TextColumn, TimeElapsedColumn
from rich.text import Text

from curio_serve.writers import ImageResult

_NUM_PROBLEMS_SHOWN = 20


class _Rate(ProgressColumn):
    """Images a second, of late."""

    def render(self, task: Task) -> Text:
        return Text(f"{task.speed or 0.0:.1f} images/s")


class Progress:
    """Counts images while they are answered.

    Args:
        num_before: Images answered by earlier runs.
        num_errors_before: Of these, without an answer.
        is_shown: Whether there may be a bar at all; it appears on a terminal alone.
    """

    def __init__(self, num_before: int, num_errors_before: int, *, is_shown: bool) -> None:
        console = Console(stderr=True)
        self._bar = Bar(
            SpinnerColumn(),
            TextColumn("{task.completed} images"),
            _Rate(),
            TextColumn("{task.fields[num_errors]} without an answer"),
            TimeElapsedColumn(),
            console=console,
            disable=not (is_shown and console.is_terminal),
        )
        self._num_before = num_before
        self._num_new = 0
        self._num_errors = num_errors_before
        self._problems: list[str] = []
        self._task = self._bar.add_task("detect", total=None, completed=num_before, num_errors=num_errors_before)
        self._start_s = time.perf_counter()

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def count(self, result: ImageResult) -> None:
        """One more image."""
        self._num_new += 1
        if result.error:
            self._num_errors += 1
            if len(self._problems) < _NUM_PROBLEMS_SHOWN:
                self._problems.append(f"{result.image}: {result.error}")
        if not self._bar.disable:
            self._bar.update(self._task, advance=1, num_errors=self._num_errors)

    def report(self, label: str) -> None:
        """Sums up, with the first problems of this run."""
        seconds = time.perf_counter() - self._start_s
        before = f" after {self._num_before} of earlier runs" if self._num_before else ""
        _say(f"{self._num_new} images{before} in {seconds:.1f} s ({self._num_new / seconds:.1f} images/s) to {label}")
        if self._num_errors:
            _say(
                f"{self._num_errors} images have no answer:" if self._problems else f"{self._num_errors} have no answer"
            )
        for problem in self._problems:
            print(f"  {problem}", file=sys.stderr)
        if len(self._problems) < self._num_errors and self._problems:
            print(f"  ... and {self._num_errors - len(self._problems)} more", file=sys.stderr)


def _say(text: str) -> None:
    print(f"curio-detect: {text}", file=sys.stderr)
