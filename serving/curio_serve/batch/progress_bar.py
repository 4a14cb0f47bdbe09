"""The bar that ``curio-detect`` shows on a terminal; apart, so that other runs need not wait for rich to load."""

from rich.console import Console
from rich.progress import Progress, ProgressColumn, SpinnerColumn, Task, TextColumn, TimeElapsedColumn
from rich.text import Text


class _Rate(ProgressColumn):
    """Images a second, of late."""

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
        """One more image; how many have no answer by now."""
        self._progress.update(self._task, advance=1, num_errors=num_errors)

    def stop(self) -> None:
        """Leave the last state standing."""
        self._progress.stop()
