"""Progress of ``curio-detect`` on standard error: a bar on a terminal, and a summary at the end."""

import sys
import time
from typing import TYPE_CHECKING, Self

from curio_serve.batch.results.formats import ImageLines
from curio_serve.imaging.view import MOSTLY_SEARCHED

if TYPE_CHECKING:
    from curio_serve.batch.progress_bar import Bar

_NUM_PROBLEMS_SHOWN = 20


class Progress:
    """Counts images while they are answered.

    Args:
        num_before: Images answered by earlier runs.
        num_errors_before: Of these, without an answer.
        is_shown: Whether there may be a bar at all; it appears on a terminal alone.
    """

    def __init__(self, num_before: int, num_errors_before: int, *, is_shown: bool) -> None:
        self._bar = _bar(num_before, num_errors_before) if is_shown and sys.stderr.isatty() else None
        self._num_before = num_before
        self._num_new = 0
        self._num_errors = num_errors_before
        self._num_turned, self._first_turned = 0, ""
        self._num_wide, self._first_wide, self._least_searched = 0, "", 1.0
        self._problems: list[str] = []
        self._start_s = time.perf_counter()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def count(self, lines: ImageLines) -> None:
        """Count one more image."""
        self._num_new += 1
        if lines.is_turned:
            self._first_turned = self._first_turned or lines.image
            self._num_turned += 1
        if lines.searched < MOSTLY_SEARCHED:
            self._first_wide = self._first_wide or lines.image
            self._num_wide, self._least_searched = self._num_wide + 1, min(self._least_searched, lines.searched)
        if lines.error:
            self._num_errors += 1
            if len(self._problems) < _NUM_PROBLEMS_SHOWN:
                self._problems.append(f"{lines.image}: {lines.error}")
        if self._bar is not None:
            self._bar.advance(self._num_errors)

    def report(self, label: str) -> None:
        """Sums up, with the first problems of this run."""
        seconds = time.perf_counter() - self._start_s
        before = f" after {self._num_before} of earlier runs" if self._num_before else ""
        _say(
            f"{_counted(self._num_new)}{before} in {seconds:.1f} s ({self._num_new / seconds:.1f} images/s) to {label}"
        )
        if self._num_before:
            _say("answers of earlier runs stay as they are, whatever flags they had; --overwrite answers all again")
        if self._num_turned:
            have = "has" if self._num_turned == 1 else "have"
            _say(
                f"{_counted(self._num_turned)} {have} an EXIF rotation that was not applied (first: "
                f"{self._first_turned}); viewers turn pictures by it, K is taken to be of the stored pixels. With "
                "--exif-rotation pixels are turned, and K with them"
            )
        if self._num_wide:
            show = "shows" if self._num_wide == 1 else "show"
            _say(
                f"{_counted(self._num_wide)} {show} more than the model's camera saw in training (first: "
                f"{self._first_wide}): the middle alone was searched, {self._least_searched:.0%} of the frame. Train "
                "with this camera, or ask curio-serve about regions of the frames"
            )
        if self._num_errors:
            have = "has" if self._num_errors == 1 else "have"
            _say(f"{_counted(self._num_errors)} {have} no answer{':' if self._problems else ''}")
        for problem in self._problems:
            print(f"  {problem}", file=sys.stderr)
        if len(self._problems) < self._num_errors and self._problems:
            print(f"  ... and {self._num_errors - len(self._problems)} more", file=sys.stderr)


def _bar(num_images: int, num_errors: int) -> "Bar":
    from curio_serve.batch.progress_bar import Bar

    return Bar(num_images, num_errors)


def _counted(num_images: int) -> str:
    return f"{num_images} image{'' if num_images == 1 else 's'}"


def _say(text: str) -> None:
    print(f"curio-detect: {text}", file=sys.stderr)
