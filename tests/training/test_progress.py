"""The progress of training on a terminal."""

import io
from pathlib import Path

from curio_train.learning.runs.progress import Reporter
from curio_train.learning.state import TrainingProgress
from rich.console import Console


def test_eighty_columns_show_a_bar_and_the_time_left(tmp_path: Path) -> None:
    screen, progress = io.StringIO(), TrainingProgress()
    reporter = Reporter(tmp_path, progress, Console(file=screen, width=80, force_terminal=True, color_system=None))
    for number in range(20):
        progress.step, progress.images, progress.seconds = number + 1, 64 * (number + 1), 0.5 * (number + 1)
        losses = {"sleep, localisation": 7.25, "sleep, crop pose": 14.5}
        reporter.step(losses, (number + 1) / 40)
    reporter.close()
    assert "\u2501\u2501\u2501" in screen.getvalue()
    assert " 50 %  0:10 left  1,280 images, 128/s  localisation loss 7.25" in screen.getvalue()
    assert f"to watch it learn: curio-view {tmp_path}, or tensorboard --logdir {tmp_path}\n" in screen.getvalue()
