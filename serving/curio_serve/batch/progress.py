"""Progress of ``curio-detect`` on standard error: a bar on a terminal, and a summary at the end."""

import sys
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

from curio_serve.batch.results.formats import ImageLines
from curio_serve.imaging.view import MOSTLY_SEARCHED

if TYPE_CHECKING:
    from rich.progress import Progress as Bar

_NUM_PROBLEMS_SHOWN = 20
_FEWEST_INSTANTS = 10  # in which cameras of a rig contradict each other, before that is told


@dataclass
class _Some:
    """Images that share what is told in the end."""

    num: int = 0
    first: str = ""

    def add(self, image: str) -> None:
        self.num, self.first = self.num + 1, self.first or image


class Progress:
    """Counts images while they are answered.

    Args:
        num_before: Images answered by earlier runs.
        num_errors_before: Of these, without an answer.
        is_shown: Whether there may be a bar at all; it appears on a terminal alone.
        are_compared: Whether answers of earlier runs are known to be of the same options.
    """

    def __init__(self, num_before: int, num_errors_before: int, *, is_shown: bool, are_compared: bool = False) -> None:
        self._bar = _started(num_before, num_errors_before) if is_shown and sys.stderr.isatty() else None
        self._num_before, self._are_compared = num_before, are_compared
        self._num_new = 0
        self._num_errors = self._num_errors_before = num_errors_before
        self._turned, self._wide, self._least_searched = _Some(), _Some(), 1.0
        self._num_agreeing = self._num_contradicting = 0
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
            self._turned.add(lines.image)
        if lines.searched < MOSTLY_SEARCHED:
            self._wide.add(lines.image)
            self._least_searched = min(self._least_searched, lines.searched)
        if lines.do_views_agree is not None:
            self._num_agreeing += lines.do_views_agree
            self._num_contradicting += not lines.do_views_agree
        if lines.error:
            self._num_errors += 1
            if len(self._problems) < _NUM_PROBLEMS_SHOWN:
                self._problems.append(_printable(f"{lines.image}: {lines.error}"))
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], advance=1, num_errors=self._num_errors)

    def report(self, label: str) -> None:
        """Sums up, with the first problems of this run."""
        seconds = time.perf_counter() - self._start_s
        before = f" after {self._num_before} of earlier runs" if self._num_before else ""
        say(f"{_counted(self._num_new)}{before} in {seconds:.1f} s ({self._num_new / seconds:.1f} images/s) to {label}")
        if self._num_before and not self._are_compared:
            say("answers of earlier runs stay as they are, whatever flags they had; --overwrite answers all again")
        elif self._num_errors_before:
            before = _counted(self._num_errors_before, "has", "have")
            say(f"{before} no answer in earlier runs and was not tried again; --overwrite answers all again")
        if self._turned.num:
            say(
                f"{_counted(self._turned.num, 'has', 'have')} an EXIF rotation that was not applied (first: "
                f"{self._turned.first}); viewers turn pictures by it, K is taken to be of the stored pixels. With "
                "--exif-rotation pixels are turned, and K with them"
            )
        if self._wide.num:
            say(
                f"{_counted(self._wide.num, 'shows', 'show')} more than the model's camera saw in training (first: "
                f"{self._wide.first}): the middle alone was searched, {self._least_searched:.0%} of the frame. Train "
                "with this camera, or ask curio-serve about regions of the frames"
            )
        if self._num_contradicting >= _FEWEST_INSTANTS and not self._num_agreeing:
            say(
                f"in none of {self._num_contradicting} instants do two cameras agree on a pose: are their "
                "cam_from_rig in the rig's file right (from the rig to the camera, metres), and do images of one line "
                "show one instant?"
            )
        if self._num_errors:
            say(f"{_counted(self._num_errors, 'has', 'have')} no answer{':' if self._problems else ''}")
        for problem in self._problems:
            print(f"  {problem}", file=sys.stderr)
        if len(self._problems) < self._num_errors and self._problems:
            print(f"  ... and {self._num_errors - len(self._problems)} more", file=sys.stderr)


def _started(num_images: int, num_errors: int) -> "Bar":
    from curio_serve.batch.progress_bar import started

    return started(num_images, num_errors)


def _counted(num_images: int, of_one: str = "", of_several: str = "") -> str:
    """The number of images, and the verb that goes with it."""
    return f"1 image {of_one}".rstrip() if num_images == 1 else f"{num_images} images {of_several}".rstrip()


def _printable(text: str) -> str:
    """A text in which a file's name cannot begin a line or colour a terminal."""
    return "".join(sign if sign.isprintable() else f"\\x{ord(sign):02x}" for sign in text)


def say(text: str) -> None:
    """A line on standard error."""
    print(f"curio-detect: {_printable(text)}", file=sys.stderr)
