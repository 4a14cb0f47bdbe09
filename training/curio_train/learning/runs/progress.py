"""What a user sees of a run: progress on stderr, curves and pictures in its folder.

::

    RUN/history.jsonl     one line every few steps: step, images, seconds, and each loss averaged since the line before
        tensorboard/      the same curves, and input | re-rendering pairs
        samples.png       the latest pairs: inputs above, re-renderings below
"""

import json
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import torch
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from curio_train.errors import CheckpointError
from curio_train.learning.state import TrainingProgress

_HISTORY = "history.jsonl"
_STEPS_A_LINE = 20  # of history and curves
_SECONDS_A_LINE = 10  # of the log where stderr is no terminal


class Reporter:
    """Follows one run; see :func:`reporting`."""

    def __init__(self, run: Path, course: TrainingProgress, console: Console) -> None:
        self._run = run
        self._course = course
        self._console = console
        self._curves = SummaryWriter(str(run / "tensorboard"), purge_step=course.step)
        self._history = (run / _HISTORY).open("a", encoding="utf-8")
        self._sums: Counter[str] = Counter()
        self._counts: Counter[str] = Counter()
        self._since = (course.step, course.images, course.seconds)
        self._logged_at = course.seconds
        self._bar: Progress | None = None
        self._task = TaskID(0)
        if console.is_terminal:
            self._bar = Progress(
                BarColumn(), TextColumn("{task.percentage:3.0f} %  {task.description}"), console=console
            )
            self._task = self._bar.add_task("starting", total=1.0)
            self._bar.start()

    def step(self, losses: dict[str, float], progress: float) -> None:
        """Take note of one step, after which ``progress`` of the budget is spent."""
        self._sums.update(losses)
        self._counts.update(losses.keys())
        if self._course.step - self._since[0] >= _STEPS_A_LINE:
            with _writing_into(self._run):
                text = self._note()
            self._show(text, progress)

    def pictures(self, pairs: tuple[Tensor, Tensor]) -> None:
        """Show inputs and re-renderings, [num, 3, height, width] each."""
        sheet = torch.cat([torch.cat(list(images.cpu()), dim=2) for images in pairs], dim=1).clamp(0, 1)
        pixels = (sheet * 255).round().byte().permute(1, 2, 0).numpy()
        _, png = cv2.imencode(".png", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))
        with _writing_into(self._run):
            self._curves.add_image("input above, re-rendering below", sheet, self._course.step)
            (self._run / "samples.png").write_bytes(png.tobytes())

    def close(self) -> None:
        """Put everything on disk and leave the terminal in order."""
        if self._bar is not None:
            self._bar.stop()
        with _writing_into(self._run), self._history, self._curves:
            if self._sums:
                self._note()

    def _note(self) -> str:
        """Write down what was gathered since the last line; returns it in words."""
        now = self._course
        images, seconds = now.images - self._since[1], now.seconds - self._since[2]
        means = {name: value / self._counts[name] for name, value in self._sums.items()}
        rate = images / max(seconds, 1e-9)
        row = {"step": now.step, "images": now.images, "seconds": round(now.seconds, 3), **means}
        self._history.write(json.dumps(row) + "\n")
        self._history.flush()
        for name, value in means.items():
            self._curves.add_scalar(f"loss/{name}", value, now.step)
        self._curves.add_scalar("images_per_second", rate, now.step)
        self._sums.clear()
        self._counts.clear()
        self._since = (now.step, now.images, now.seconds)
        losses = "  ".join(f"{name} {value:.4g}" for name, value in means.items())
        return f"{now.images:,} images  {losses}  {rate:.0f} images/s"

    def _show(self, text: str, progress: float) -> None:
        seconds = self._course.seconds
        text += f"  {_clock(seconds * max(0.0, 1 / progress - 1))} left"
        if self._bar is not None:
            self._bar.update(self._task, completed=min(progress, 1.0), description=text)
        elif seconds - self._logged_at >= _SECONDS_A_LINE:
            self._console.print(f"{_clock(seconds)}  {text}", soft_wrap=True)
            self._logged_at = seconds


@contextmanager
def reporting(run: Path, course: TrainingProgress) -> Iterator[Reporter]:
    """Follow a run from ``course`` on; what was noted after that point, by a session since killed, is dropped."""
    with _writing_into(run):
        _drop_after(run, course.step)
        reporter = Reporter(run, course, Console(stderr=True, highlight=False))
    try:
        yield reporter
    finally:
        reporter.close()


@contextmanager
def _writing_into(run: Path) -> Iterator[None]:
    try:
        yield
    except OSError as exc:
        raise CheckpointError(
            f"cannot write into {run}: {exc.strerror}; make room, then go on with --resume {run}"
        ) from exc


def read_history(run: Path) -> list[dict[str, Any]]:
    """The lines of ``history.jsonl``, without one that was cut off by a kill; none where there is no such file."""
    file = run / _HISTORY
    lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    return [json.loads(line) for line in lines if line.endswith("}")]


def _drop_after(run: Path, step: int) -> None:
    if (run / _HISTORY).exists():
        kept = [row for row in read_history(run) if row["step"] <= step]
        (run / _HISTORY).write_text("".join(json.dumps(row) + "\n" for row in kept), encoding="utf-8")


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
