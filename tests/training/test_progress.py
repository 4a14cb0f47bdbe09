"""The progress of training on a terminal."""

import io
from pathlib import Path

import pytest
from curio_train.learning.runs.progress import Reporter
from curio_train.learning.state import TrainingProgress
from rich.console import Console


@pytest.mark.parametrize("is_flat", [False, True])
def test_how_to_watch_names_what_can_show_the_world(tmp_path: Path, is_flat: bool) -> None:
    screen = io.StringIO()
    Reporter(tmp_path, TrainingProgress(), Console(file=screen, width=80), is_flat=is_flat).close()
    viewed = "" if is_flat else f"curio-view {tmp_path}, or "
    assert f"to watch it learn: {viewed}tensorboard --logdir {tmp_path}\n" in screen.getvalue()


@pytest.mark.parametrize(("drawing_s", "spent"), [(0.0, 0.0), (100.0, 0.0), (100.0, 0.25)])
def test_eighty_columns_show_a_bar_and_the_time_left(tmp_path: Path, drawing_s: float, spent: float) -> None:
    """What was done before the first step, templates drawn or half a run, tells nothing about the steps that are left.

    20 steps of 0.5 s take the share from ``spent`` to one half.
    """
    screen, progress = io.StringIO(), TrainingProgress(seconds=drawing_s)
    console = Console(file=screen, width=80, force_terminal=True, color_system=None)
    reporter = Reporter(tmp_path, progress, console, is_flat=False)
    for number in range(20):
        progress.step, progress.images, progress.seconds = number + 1, 64 * (number + 1), drawing_s + 0.5 * (number + 1)
        losses = {"sleep, localisation": 7.25, "sleep, crop pose": 14.5}
        reporter.step(losses, spent + (0.5 - spent) * (number + 1) / 20)
    reporter.close()
    assert "\u2501\u2501\u2501" in screen.getvalue()
    left = "0:10" if spent == 0 else "0:20"
    assert f" 50 %  {left} left  1,280 images, 128/s  localisation loss 7.25" in screen.getvalue()
