"""The progress bar of ``curio-detect``; in a module of its own, so that runs without a bar need not load rich."""

from rich.console import Console
from rich.progress import Progress, ProgressColumn, SpinnerColumn, Task, TextColumn, TimeElapsedColumn
from rich.text import Text


class _Rate(ProgressColumn):
    """Recent images per second."""

    def render(self, task: Task) -> Text:
        return Text(f"{task.speed or 0.0:.1f} images/s")


def started(num_images: int, num_errors: int) -> Progress:
    """A bar on standard error with one task, the images answered so far.

    Args:
        num_images: Answered by earlier runs.
        num_errors: Of these, without an answer; the task's field of this name is shown.
    """
    progress = Progress(
        SpinnerColumn(),
        TextColumn("{task.completed} images"),
        _Rate(),
        TextColumn("{task.fields[num_errors]} without an answer"),
        TimeElapsedColumn(),
        console=Console(stderr=True),
    )
    progress.add_task("detect", total=None, completed=num_images, num_errors=num_errors)
    progress.start()
    return progress
