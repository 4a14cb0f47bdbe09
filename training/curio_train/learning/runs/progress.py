"""Progress of a run: a bar on stderr, curves and pictures in the run folder.

::

    RUN/history.jsonl     one line every few steps: step, images, seconds, and each loss averaged since the line before;
                          and one a checkpoint with the image error (DSSIM) of the re-renderings of the same images
        tensorboard/      the same curves, and input | re-rendering pairs
        samples.png       the latest pairs: inputs above, re-renderings below
        stages/IMAGES.png the same at stages of training: after so many images, each stage twice as long as before
"""

import json
import shlex
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import torch
from curio_serve.files import read_file, write_whole
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn
from rich.table import Column
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from curio_train.errors import CheckpointError
from curio_train.learning.state import TrainingProgress
from curio_train.metrics.images import dssim

IMAGE_ERROR = "image_dssim"
"""Key of the image error in lines of the history."""

_HISTORY, _STAGES = "history.jsonl", "stages"
_MAX_HISTORY_BYTES = 1 << 28
_STEPS_A_LINE = 20  # of history and curves
_SECONDS_A_LINE = 10  # of the log where stderr is no terminal
_BAR_WIDTH = 12


class Reporter:
    """Reports the progress of one run; see :func:`reporting`."""

    def __init__(self, run: Path, progress: TrainingProgress, console: Console, *, is_flat: bool) -> None:
        self._run = run
        self._progress = progress
        self._console = console
        self._curves = SummaryWriter(str(run / "tensorboard"), purge_step=progress.step)
        self._history = (run / _HISTORY).open("a", encoding="utf-8")
        self._sums: Counter[str] = Counter()
        self._counts: Counter[str] = Counter()
        self._since = (progress.step, progress.images, progress.seconds)
        self._logged_at = progress.seconds
        self._first: tuple[float, float] | None = None  # fraction of the budget and seconds after the first step
        quoted = shlex.quote(str(run))
        viewed = "" if is_flat else f"curio-view {quoted}, or "
        console.print(f"{run}: to watch it learn: {viewed}tensorboard --logdir {quoted}", soft_wrap=True, markup=False)
        self._bar: Progress | None = None
        self._task = TaskID(0)
        if console.is_terminal:
            # The bar keeps its place in narrow terminals: the text beside it is cut off at its end, the losses.
            bar_column, text_column = Column(width=_BAR_WIDTH), Column(ratio=1, no_wrap=True)
            text = TextColumn("{task.percentage:3.0f} %  {task.description}", table_column=text_column)
            self._bar = Progress(BarColumn(table_column=bar_column), text, console=console, expand=True)
            self._task = self._bar.add_task("starting", total=1.0)
            self._bar.start()

    def step(self, losses: dict[str, float], spent: float) -> None:
        """Report one step.

        Args:
            losses: By name.
            spent: Fraction of the budget after the step.
        """
        if self._first is None:
            self._first = (spent, self._progress.seconds)
        self._sums.update(losses)
        self._counts.update(losses.keys())
        if self._progress.step - self._since[0] >= _STEPS_A_LINE:
            with _writing_into(self._run):
                text = self._note()
            self._show(text, spent)

    def pictures(self, pairs: tuple[Tensor, Tensor]) -> None:
        """Save pairs of inputs and re-renderings, [num, 3, height, width] each, as a picture, and note their DSSIM."""
        error = float(dssim(*(images.cpu().clamp(0, 1) for images in pairs)).mean())
        sheet = torch.cat([torch.cat(list(images.cpu()), dim=2) for images in pairs], dim=1).clamp(0, 1)
        pixels = (sheet * 255).round().byte().permute(1, 2, 0).numpy()
        _, png = cv2.imencode(".png", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))
        last = max((images for images, _ in stage_pictures(self._run)), default=0)
        with _writing_into(self._run):
            if self._progress.images >= 2 * last:
                (self._run / _STAGES).mkdir(exist_ok=True)
                (self._run / _STAGES / f"{self._progress.images:09d}.png").write_bytes(png.tobytes())
            self._curves.add_image("input above, re-rendering below", sheet, self._progress.step)
            (self._run / "samples.png").write_bytes(png.tobytes())
            self._write({IMAGE_ERROR: error})

    def say(self, text: str) -> None:
        """Print a line beside the bar, about what takes long and is no step."""
        self._console.print(text, soft_wrap=True, markup=False)

    def close(self) -> None:
        """Write what is not yet on disk, and end the bar."""
        if self._bar is not None:
            self._bar.stop()
        with _writing_into(self._run), self._history, self._curves:
            if self._sums:
                self._note()

    def _note(self) -> str:
        """Write the means since the last line to history and curves; returns them as text."""
        now = self._progress
        images, seconds = now.images - self._since[1], now.seconds - self._since[2]
        means = {name: value / self._counts[name] for name, value in self._sums.items()}
        rate = images / max(seconds, 1e-9)
        self._write(means)
        for name, value in means.items():
            self._curves.add_scalar(f"loss/{name}", value, now.step)
        self._curves.add_scalar("images_per_second", rate, now.step)
        self._sums.clear()
        self._counts.clear()
        self._since = (now.step, now.images, now.seconds)
        losses = ", ".join(f"{_named(name)} {value:.4g}" for name, value in means.items())
        return f"{now.images:,} images, {rate:.0f}/s  {losses}"

    def _write(self, values: dict[str, float]) -> None:
        now = self._progress
        row = {"step": now.step, "images": now.images, "seconds": round(now.seconds, 3), **values}
        self._history.write(json.dumps(row) + "\n")
        self._history.flush()

    def _show(self, text: str, spent: float) -> None:
        seconds = self._progress.seconds
        # Since the first step: what was drawn before it takes as long for any budget.
        first_spent, first_seconds = self._first or (0.0, 0.0)
        rate = max(spent - first_spent, 1e-9) / max(seconds - first_seconds, 1e-9)
        text = f"{_clock(max(0.0, 1 - spent) / rate)} left  {text}"
        if self._bar is not None:
            self._bar.update(self._task, completed=min(spent, 1.0), description=text)
        elif seconds - self._logged_at >= _SECONDS_A_LINE:
            self._console.print(f"{_clock(seconds)}  {text}", soft_wrap=True)
            self._logged_at = seconds


@contextmanager
def reporting(run: Path, progress: TrainingProgress, *, is_flat: bool) -> Iterator[Reporter]:
    """Report a run from ``progress`` on; drops lines of a killed session that are later than that.

    Args:
        run: The run folder.
        progress: Counted on by whoever trains.
        is_flat: Whether the run's world is one that ``curio-view`` cannot show.

    Raises:
        CheckpointError: The run folder cannot be written into.
    """
    with _writing_into(run):
        _drop_after(run, progress.step)
        reporter = Reporter(run, progress, Console(stderr=True, highlight=False), is_flat=is_flat)
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
            f"cannot write into {run}: {exc.strerror}; make room, then continue with --resume {run}"
        ) from exc


def stage_pictures(run: Path) -> list[tuple[int, Path]]:
    """Pictures of the stages of training, each with the images seen by then, earliest first."""
    return [(int(path.stem), path) for path in sorted((run / _STAGES).glob("[0-9]*.png"))]


def read_history(run: Path) -> list[dict[str, Any]]:
    """The lines of ``history.jsonl``, without one that was cut off by a kill; none where there is no such file.

    Raises:
        CheckpointError: The file is damaged.
    """
    file = run / _HISTORY
    try:
        lines = read_file(file, _MAX_HISTORY_BYTES).decode("utf-8").splitlines() if file.exists() else []
        rows = [json.loads(line) for line in lines if line.endswith("}")]
        if all(isinstance(row, dict) and type(row.get("step")) is int for row in rows):
            return rows
        reason = "a line without a step"
    except (OSError, ValueError, RecursionError) as exc:
        reason = str(exc)
    raise CheckpointError(f"{file} cannot be read ({reason}); delete it to go on without the curves so far")


def _named(loss: str) -> str:
    """A loss for people: "image loss"; where stages of a network learn in turn, "crop pose loss"."""
    term, _, stage = loss.partition(", ")
    return f"{stage or term} loss"


def _drop_after(run: Path, step: int) -> None:
    if (run / _HISTORY).exists():
        kept = [row for row in read_history(run) if row["step"] <= step]
        write_whole(run / _HISTORY, "".join(json.dumps(row) + "\n" for row in kept))


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
