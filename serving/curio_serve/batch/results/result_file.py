"""A result file that only grows, stays valid whatever stops the process, and says which images it already answers.

The lines of one image reach the operating system in one call, so that ``kill -9`` leaves complete lines and at most
one torn end. A file that is opened again is read once, front to back, beside the list of images: its lines must be the
beginning of that list, in order. The torn end is cut off and the rest of the images follow, so that the finished file
is the one that an uninterrupted run would have written. Neither the file nor the list is ever held in memory.
"""

import json
import os
import stat
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO, Protocol, TypeVar

from curio_serve.batch.results.formats import ImageLines, Line, ResultFormat
from curio_serve.errors import OutputError, UsageError
from curio_serve.files import direct
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.systems import APPEND_FLAGS, lock


class Named(Protocol):
    """An image with the name that its result carries."""

    @property
    def name(self) -> str: ...


NamedT = TypeVar("NamedT", bound=Named)
_SAME_PX, _SAME_LENS = 0.01, 1e-6  # between entries of K, and coefficients of the lens
_LONGEST_CAMERA = 9 + 8


class ResultFile:
    """Writes results in the order of the images, and resumes after a stop.

    Args:
        path: The file; None: standard output.
        form: Format of its lines.
        models: Names and versions of those whose results it holds, in the order of an image's lines.
        overwrite: Drop what is in it.
        camera_of: The camera by which an image would be answered, as in :class:`Line`; none: not known. Lines by
            another one are not gone on with.

    Raises:
        OutputError: The file cannot be opened for writing, or another process writes it.
    """

    num_images: int
    """Answered in the file, those of earlier runs included."""
    num_errors: int
    """Images that failed, where the format says so."""

    def __init__(
        self,
        path: Path | None,
        form: ResultFormat,
        models: Sequence[tuple[str, int]],
        *,
        overwrite: bool = False,
        camera_of: Callable[[Any], Sequence[float]] = lambda _: (),
    ) -> None:
        self.num_images = 0
        self.num_errors = 0
        self._path = path
        self._form = form
        self._models = tuple(models)
        self._camera_of = camera_of
        self._descriptor = os.dup(1) if path is None else open_locked(path)
        self._is_regular = path is not None and stat.S_ISREG(os.fstat(self._descriptor).st_mode)
        self._overwrites = self._is_regular and overwrite

    def __enter__(self) -> "ResultFile":
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._descriptor)

    @property
    def label(self) -> str:
        return "standard output" if self._path is None else str(self._path)

    def unanswered(self, images: Iterator[NamedT]) -> Iterator[NamedT]:
        """The images that the file does not answer yet. The file is then ready to be appended to.

        Args:
            images: All of them, in order; those already answered are taken from it.

        Raises:
            UsageError: The file holds something else: another format, model, or other images.
        """
        if self._overwrites:
            first = next(images, None)
            if first is None:
                return images  # earlier results are worth more than none
            self._form.key(first.name)  # which may be no name in this format
            os.ftruncate(self._descriptor, 0)
            images = chain((first,), images)
        if self._is_regular:
            with open(os.dup(self._descriptor), "rb") as lines:
                lines.seek(0)
                end = self._skip_answered(lines, images)
            os.ftruncate(self._descriptor, end)
        else:
            end = 0
        if end == 0:
            self._append(self._form.header)
        return images

    def write(self, lines: ImageLines) -> None:
        """Appends one image.

        Raises:
            OutputError: The disk is full or the file cannot be written; its earlier lines stay valid.
            BrokenPipeError: Whoever read standard output has gone.
        """
        self._append(lines.data)
        self.num_images += 1
        self.num_errors += bool(lines.error)

    def _append(self, data: bytes) -> None:
        rest = memoryview(data)
        start = os.lseek(self._descriptor, 0, os.SEEK_END) if self._is_regular else 0
        try:
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
        except BrokenPipeError:
            raise
        except OSError as exc:
            if self._is_regular:
                os.ftruncate(self._descriptor, start)
            raise OutputError(
                f"cannot write to {self.label}: {exc.strerror}. The {self.num_images} images before are safe in it; "
                "make room and run the same command again to go on."
            ) from exc

    def _skip_answered(self, lines: BinaryIO, images: Iterator[NamedT]) -> int:
        """Takes the answered images off the iterator and returns where in the file the first other one belongs."""
        opening = lines.read(len(self._form.opening))
        if not self._form.opening.startswith(opening):
            raise self._mismatch(1, f"{opening!r}, where this format begins with {self._form.opening!r}")
        if len(opening) < len(self._form.opening):  # empty, or torn right at the start
            return 0
        start = lines.seek(len(self._form.header))
        number = int(bool(self._form.header))
        last: _Image | None = None
        for line in lines:
            number += 1
            if not line.endswith(b"\n"):
                break
            record = self._parse(line, number)
            opens = record.opens_image and record.model in (None, self._models[0])
            if last is None or opens or record.key != last.key:
                if last is not None:
                    self._take(last, images, number - 1)
                last = _Image(record.key, start)
            last.add(record)
            start += len(line)
        if last is None:
            return start
        if self._form.is_one_line_an_image and tuple(last.models) == self._models:
            self._take(last, images, number)
            return start
        return last.start  # more rows of this image may have been lost: it is answered anew

    def _parse(self, line: bytes, number: int) -> Line:
        try:
            record = self._form.parse(line)
        except (ValueError, StopIteration, RecursionError) as exc:
            raise self._mismatch(number, f"what this format does not write ({exc})") from exc
        if record.model is not None and record.model not in self._models:
            raise self._mismatch(number, f"results of model {_label([record.model])}; this is {_label(self._models)}")
        if record.options is not None and record.options != self._form.options:
            before, now = (json.dumps(options) for options in (record.options, self._form.options))
            raise self._mismatch(number, f"answers with other options: {before} instead of {now}")
        return record

    def _take(self, last: "_Image", images: Iterator[NamedT], number: int) -> None:
        """Takes images off the iterator up to the one whose lines were read."""
        if last.models and tuple(last.models) != self._models:
            raise self._mismatch(
                number, f"results of model {_label(last.models)} alone about {last.key}; this is {_label(self._models)}"
            )
        for image in images:
            self.num_images += 1
            found = self._form.key(image.name)
            if found == last.key:
                self._refuse_other_camera(last, self._camera_of(image), number)
                self.num_errors += last.is_error
                return
            if self._form.has_line_for_every_image:
                raise self._mismatch(number, f"image {last.key} where the images given have {found}")
        raise self._mismatch(number, f"image {last.key}, which is not among the images given or not in this order")

    def _refuse_other_camera(self, last: "_Image", camera: Sequence[float], number: int) -> None:
        if not last.camera or not camera:
            return
        before, now = (list(values) + [0.0] * (_LONGEST_CAMERA - len(values)) for values in (last.camera, camera))
        pairs = zip(before, now, [_SAME_PX] * 9 + [_SAME_LENS] * (_LONGEST_CAMERA - 9), strict=True)
        if any(abs(a - b) > tolerance for a, b, tolerance in pairs):
            raise self._mismatch(
                number,
                f"poses by another camera (fx {before[0]:g} px, k1 {before[9]:g}; now {now[0]:g} px, {now[9]:g})",
            )

    def _mismatch(self, number: int, found: str) -> UsageError:
        return UsageError(
            f"cannot go on with {self.label}: line {number} holds {found}. Give the same images, camera, model, "
            "options and format as before, another --out, or --overwrite to replace the file."
        )


@dataclass
class _Image:
    """The lines of one image, while they are read back."""

    key: str
    """See :meth:`ResultFormat.key`."""
    start: int
    """Offset of the first line."""
    models: list[tuple[str, int]] = field(default_factory=list)
    """The models of its lines, if the format names them."""
    is_error: bool = False
    """Whether a model had no answer."""
    camera: tuple[float, ...] = ()
    """See :class:`Line`."""

    def add(self, line: Line) -> None:
        if line.model is not None and line.model not in self.models:
            self.models.append(line.model)
        self.is_error |= line.is_error
        self.camera = self.camera or line.camera


def values_of(camera: PinholeCamera) -> tuple[float, ...]:
    """A camera as lines have it: K row after row, then the distortion if there is any."""
    lens = camera.distortion if any(camera.distortion) else ()
    return (*map(float, camera.matrix.ravel()), *map(float, lens))


def _label(models: Sequence[tuple[str, int]]) -> str:
    return ", ".join(f"{name} version {version}" for name, version in models)


def open_locked(path: Path) -> int:
    """Open a file for reading and appending, and lock it against our other processes.

    Raises:
        OutputError: It cannot be opened, or another process writes it.
    """
    try:
        path = direct(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, APPEND_FLAGS, 0o666)
    except OSError as exc:
        raise OutputError(f"--out {path}: cannot be opened for writing: {exc.strerror}") from exc
    if not lock(descriptor):
        os.close(descriptor)
        raise OutputError(f"--out {path}: another process is writing it")
    return descriptor
