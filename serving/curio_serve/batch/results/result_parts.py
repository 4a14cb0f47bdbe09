"""Results in an object store, which cannot append: a folder of parts, each put whole.

``--out s3://bucket/poses.jsonl`` writes ``s3://bucket/poses.jsonl/part-00000.jsonl`` and so on. Joined in the order of
their names they are the file that a run on this machine would have written. A part holds complete images and is put
every minute, every 8 MiB, and when the run ends or is stopped. A process that is killed loses the answers since the
last part alone; the next run reads the parts back, checks them as :class:`ResultFile` checks a file, and goes on there.
"""

import posixpath
import re
import time
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from curio_serve.batch.images.remote_files import RemoteFiles, is_store
from curio_serve.batch.results.formats import ImageLines, ResultFormat
from curio_serve.batch.results.result_file import NamedT, ResultFile
from curio_serve.errors import ImageError, OutputError, Unavailable, UsageError

_PART_BYTES = 8 << 20
_PART_S = 60.0
_MAX_PART_BYTES = 1 << 30
_PART = re.compile(r"part-(\d{5,})\.[a-z]+")


class ResultParts:
    """Writes results to a :class:`ResultFile` in a temporary folder, and uploads what is new in it as parts.

    Args:
        url: Of the folder of parts, in an object store.
        form: Format of the lines.
        models: As of :class:`ResultFile`.
        overwrite: Remove the parts that are there, once there is an image to be answered.
        every_s: Seconds from one part to the next.
        camera_of: As of :class:`ResultFile`.

    Raises:
        UsageError: The URL is of no store, or the folder holds something else.
        OutputError: The store refuses.
        Unavailable: The store does not answer.
    """

    def __init__(
        self,
        url: str,
        form: ResultFormat,
        models: Sequence[tuple[str, int]],
        *,
        overwrite: bool = False,
        every_s: float = _PART_S,
        camera_of: Callable[[Any], Sequence[float]] = lambda _: (),
    ) -> None:
        if not is_store(url):
            raise UsageError(f"--out {url}: cannot be written; expected a file, s3://… or gs://…")
        self.label = url.rstrip("/")
        self._suffix = posixpath.splitext(self.label)[1] or ".jsonl"
        self._files = RemoteFiles(url.partition("://")[0])
        names = self._names()
        self._replaced, names = (names, []) if overwrite else ([], names)
        self._folder = TemporaryDirectory(prefix="curio-detect-")
        path = Path(self._folder.name) / "results"
        self._starts = [0]
        with path.open("wb") as joined:
            for name in names:
                joined.write(self._read(name))
                self._starts.append(joined.tell())
        self._path, self._form = path, form
        self._file = ResultFile(path, form, models, camera_of=camera_of)
        self._every_s, self._last_put = every_s, time.monotonic()

    @property
    def num_images(self) -> int:
        """As of :class:`ResultFile`."""
        return self._file.num_images

    @property
    def num_errors(self) -> int:
        """As of :class:`ResultFile`."""
        return self._file.num_errors

    def __enter__(self) -> "ResultParts":
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._put()
        finally:
            self._file.__exit__()
            self._folder.cleanup()

    def unanswered(self, images: Iterator[NamedT]) -> Iterator[NamedT]:
        """The images that no part answers yet; see :meth:`ResultFile.unanswered`.

        Raises:
            UsageError: As there.
            OutputError: A part that is to be replaced cannot be removed.
        """
        first = next(images, None)
        if first is None and self._replaced:
            return images  # earlier results are worth more than none
        if first is not None:
            self._form.key(first.name)  # which may be no name in this format
            images = chain((first,), images)
        for name in reversed(self._replaced):  # the first ones stay a valid beginning should this be stopped
            self._remove(name)
        remaining = self._file.unanswered(images)
        while len(self._starts) > 1 and self._starts[-1] > self._path.stat().st_size:
            self._starts.pop()  # the last image of this part is answered anew, and the part then replaced
        return remaining

    def write(self, lines: ImageLines) -> None:
        """Append one image. From time to time all images since the last part become the next part.

        Raises:
            OutputError: The store refuses, or the disk of the temporary folder is full.
            Unavailable: The store does not answer.
        """
        self._file.write(lines)
        is_full = self._path.stat().st_size - self._starts[-1] >= _PART_BYTES
        if is_full or time.monotonic() - self._last_put >= self._every_s:
            self._put()

    def _put(self) -> None:
        with self._path.open("rb") as joined:
            joined.seek(self._starts[-1])
            data = joined.read()
        if not data:
            return
        name = self._name(len(self._starts) - 1)
        try:
            self._files.write(name, data)
        except OSError as exc:
            raise OutputError(f"--out: {name} cannot be written: {exc.strerror}") from exc
        self._starts.append(self._starts[-1] + len(data))
        self._last_put = time.monotonic()

    def _names(self) -> list[str]:
        found = []
        for name in self._files.below(self.label + "/"):
            match = _PART.fullmatch(name.removeprefix(self.label + "/"))
            if match is None:
                raise UsageError(f"--out {self.label}: holds {name}, which is no part of results; choose another --out")
            found.append((int(match[1]), name))
        numbers = [number for number, _ in sorted(found)]
        if numbers != list(range(len(numbers))):
            missing = next(number for number, there in enumerate(numbers) if number != there)
            raise UsageError(f"--out {self.label}: {self._name(missing)} is missing; restore it, or use --overwrite")
        return [name for _, name in sorted(found)]

    def _name(self, number: int) -> str:
        return f"{self.label}/part-{number:05d}{self._suffix}"

    def _read(self, name: str) -> bytes:
        try:
            return self._files.read(name, _MAX_PART_BYTES)
        except ImageError as exc:
            raise OutputError(f"--out: {name} {exc}") from exc

    def _remove(self, name: str) -> None:
        try:
            self._files.remove(name)
        except (OSError, Unavailable) as exc:
            raise OutputError(f"--overwrite: {name} cannot be removed: {exc}") from exc
