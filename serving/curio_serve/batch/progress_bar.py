"""The progress bar of ``curio-detect``; in a module of its own, so that runs without a bar need not load rich."""

from rich.console import Console
from rich.progress import Progress, ProgressColumn, SpinnerColumn, Task, TextColumn, TimeElapsedColumn
from rich.text import Text


class _Rate(ProgressColumn):
    """Recent images per second."""

    def render(self, task: Task) -> Text:
        return Text(f"{task.speed or 0.0:.1f} images/s")


class Bar:
    """Images answered so far, on standard error.

    Args:
        num_images: Answered by earlier runs.
        num_errors: Of these, without an answer.
    """

    def __init__(self, num_images: int, num_errors: int) -> None:
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.completed} images"),
            _Rate(),
            TextColumn("{task.fields[num_errors]} without an answer"),
            TimeElapsedColumn(),
            console=Console(stderr=True),
        )
        self._task = self._progress.add_task("detect", total=None, completed=num_images, num_errors=num_errors)
        self._progress.start()

    def advance(self, num_errors: int) -> None:
        """Count one more image, and show how many have no answer so far."""
        self._progress.update(self._task, advance=1, num_errors=num_errors)

    def stop(self) -> None:
        """Stop, and leave the last state on the terminal."""
        self._progress.stop()
