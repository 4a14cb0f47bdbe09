"""Lists the images that a command line names by files, folders, globs, videos, recordings or a list, one at a time.

The order is the order of the arguments, and inside a folder that of the names, where numbers count by their value:
``frame10.png`` follows ``frame9.png``. Only an object store gives its own order. Nothing here grows with the number of
images: a folder of a million is listed in batches, and a video is read as it is used.
"""

import glob
import heapq
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePath
from typing import BinaryIO

from curio_serve.batch.images.remote_files import files_of, is_store, is_url, path_of
from curio_serve.batch.images.source_image import SourceImage, Topics
from curio_serve.errors import UsageError
from curio_serve.files import Place, by_number, check_regular
from curio_serve.imaging.video import decoded_frames
from curio_serve.models.model_folder import CONFIG_FILE

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp"})
VIDEO_SUFFIXES = frozenset({".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v"})
RECORDING_SUFFIX = ".mcap"
LIST_SUFFIX = ".txt"  # of a URL: names of images
STANDARD_INPUT = "-"

_NAMED = 20  # files passed over that are named; the others are counted
_HEIC = (".heic", ".heif")
_NAMES_A_PASS = 1 << 16
_STDIN_BYTES = 1 << 16
_BOP_SCENE_FILES = ("scene_camera.json", "scene_gt.json")
_BOP_IMAGE_FOLDERS = ("rgb", "gray")
ANY_TOPICS = Topics()
"""The only topic of images that a recording has."""


def is_recording(path: str) -> bool:
    """Whether a path names a recording, by its suffix."""
    return PurePath(path).suffix.lower() == RECORDING_SUFFIX


class PassedOver:
    """Counts the other files in folders of images, for a summary at the end of a run."""

    def __init__(self) -> None:
        self._num_files, self._has_heic = 0, False
        self._first, self._empty, self._links = list[str](), list[str](), list[str]()

    def file(self, name: str) -> None:
        """Count a file that is no image."""
        self._num_files += 1
        self._has_heic |= name.lower().endswith(_HEIC)
        if len(self._first) < _NAMED:
            self._first.append(name)

    def empty_folder(self, path: str) -> None:
        """Count a folder in which no image lies, at any depth."""
        self._empty.append(path)

    def link(self, name: str) -> None:
        """Count a link to a folder, which may lead round in a circle."""
        self._links.append(name)

    def lines(self) -> Iterator[str]:
        """The summary, in lines."""
        if self._links:
            more = ", …" if len(self._links) > _NAMED else ""
            named = ", ".join(self._links[:_NAMED]) + more
            yield f"links to folders are not followed: {named}; name these folders, too, if they hold images"
        yield from (f"{path} holds no image" for path in self._empty)
        if self._num_files:
            unnamed = self._num_files - len(self._first)
            more = f" and {unnamed:,} more" if unnamed else ""
            verb = "file is no image" if self._num_files == 1 else "files are no images"
            yield f"passed over: {self._num_files} {verb}: {', '.join(self._first)}{more}"
            if self._has_heic:
                yield "HEIC pictures have to be converted first, for example by heif-convert or ImageMagick"


def check_arguments(arguments: Sequence[str]) -> None:
    """Refuse a call that names something that does not exist, before any work.

    Raises:
        UsageError: Says which argument.
    """
    if not arguments:
        raise UsageError(
            "no images given; expected files, folders, globs, videos, URLs, or - for a list on standard input"
        )
    if arguments.count(STANDARD_INPUT) > 1:
        raise UsageError("- was given twice; standard input can be read once")
    for argument in arguments:
        if is_url(argument):
            files_of(argument)
            continue
        if os.path.exists(os.path.join(argument, CONFIG_FILE)):
            raise UsageError(
                f"{argument} is a model and stands after the images; name all models before the first image"
            )
        if argument != STANDARD_INPUT and not os.path.exists(argument) and not _has_match(argument):
            raise UsageError(f"{argument}: no such file or folder, and no file matches it; check the path")


def images(
    arguments: Sequence[str],
    passed_over: PassedOver,
    topics: Topics = ANY_TOPICS,
) -> Iterator[SourceImage]:
    """Every image that the arguments name, in order; a folder that cannot be listed is one image with that error.

    Args:
        arguments: As on the command line.
        passed_over: Counts the other files.
        topics: What to read of recordings.
    """
    for argument in arguments:
        if argument == STANDARD_INPUT:
            for line in _lines_as_they_come(sys.stdin.buffer):
                if path := os.fsdecode(line.rstrip(b"\r")):
                    yield from _images_at(path, passed_over, topics)
        else:
            for path in [argument] if is_url(argument) else matching_paths(argument):
                yield from _images_at(path, passed_over, topics)


def _lines_as_they_come(stream: BinaryIO) -> Iterator[bytes]:
    """The lines of a stream without their ends.

    They are read past its buffer: a thread that waits within one for more holds its lock, and Python cannot end.
    """
    unbuffered, rest = getattr(stream, "raw", stream), b""
    while data := unbuffered.read(_STDIN_BYTES):
        *lines, rest = (rest + data).split(b"\n")
        yield from lines
    yield rest


def matching_paths(argument: str) -> list[str]:
    """The files and folders that an argument names, itself or those that its wildcards match; none of a URL or a list.

    Args:
        argument: As on the command line.
    """
    return [argument] if os.path.exists(argument) else sorted(glob.iglob(argument, recursive=True), key=by_number)


def names_recordings(argument: str) -> bool:
    """Whether an argument of the command line names recordings alone."""
    paths = matching_paths(argument)
    return bool(paths) and all(map(is_recording, paths))


def common_folder(arguments: Sequence[str]) -> Path:
    """The deepest folder that holds everything the arguments name: below it, relative paths are distinct.

    Raises:
        UsageError: They lie on several of Windows' drives.
    """
    folders = [os.getcwd() if a == STANDARD_INPUT or is_url(a) else _folder_of(os.path.abspath(a)) for a in arguments]
    try:
        return Path(os.path.commonpath(folders))
    except ValueError as exc:
        raise UsageError(f"the images lie on several drives: {', '.join(folders)}; a call takes those of one") from exc


def _folder_of(path: str) -> str:
    """The folder itself, a file's folder, or the part of a glob before its first wildcard."""
    while not os.path.isdir(path):
        path = os.path.dirname(path)
    return path


def _has_match(pattern: str) -> bool:
    return glob.has_magic(pattern) and next(glob.iglob(pattern, recursive=True), None) is not None


def _images_at(path: str, passed_over: PassedOver, topics: Topics) -> Iterator[SourceImage]:
    is_folder = _is_remote_folder(path) if is_url(path) else os.path.isdir(path)
    if is_folder:
        found = _remote_images(path, passed_over) if is_url(path) else _images_below(path, passed_over)
        first = next(found, None)
        if first is None:
            passed_over.empty_folder(path)
        else:
            yield first
            yield from found
    elif is_url(path):
        is_list = _url_suffix(path) == LIST_SUFFIX
        yield from map(_remote_image, files_of(path).names_in_list(path) if is_list else [path])
    elif PurePath(path).suffix.lower() in VIDEO_SUFFIXES:
        yield from _video_frames(path)
    elif is_recording(path):
        yield from _recorded_images(path, topics)
    else:
        yield SourceImage(path, path)


def _is_remote_folder(url: str) -> bool:
    return is_store(url) and (url.endswith("/") or not _url_suffix(url))


def _url_suffix(url: str) -> str:
    """Suffix of the file that a URL names, with its dot; empty where it names a server or a bucket alone."""
    return PurePath(path_of(url)).suffix.lower() if "/" in url.partition("://")[2].rstrip("/") else ""


def _remote_image(url: str) -> SourceImage:
    if _url_suffix(url) in VIDEO_SUFFIXES | {RECORDING_SUFFIX}:
        return SourceImage(url, url, error="cannot be read: videos and recordings are read from files; download it")
    return SourceImage(url, url)


def _remote_images(folder: str, passed_over: PassedOver) -> Iterator[SourceImage]:
    """Image objects of a folder in a store and of those below it, in the order of their keys."""
    for url in files_of(folder).below(folder.rstrip("/") + "/"):
        if _url_suffix(url) in IMAGE_SUFFIXES:
            yield SourceImage(url, url)
        else:
            passed_over.file(url)


def _images_below(folder: str, passed_over: PassedOver) -> Iterator[SourceImage]:
    """Image files of a folder and its sub-folders; of a BOP scene the photographs alone, not its depths and masks."""
    is_bop_scene = any(os.path.exists(os.path.join(folder, name)) for name in _BOP_SCENE_FILES)
    try:
        for name, is_folder in _sorted_entries(folder, passed_over):
            if not is_folder:
                yield SourceImage(os.path.join(folder, name), os.path.join(folder, name))
            elif not is_bop_scene or name in _BOP_IMAGE_FOLDERS:
                yield from _images_below(os.path.join(folder, name), passed_over)
    except OSError as exc:
        yield SourceImage(folder, folder, error=f"cannot be listed: {exc.strerror}")


def _sorted_entries(folder: str, passed_over: PassedOver) -> Iterator[tuple[str, bool]]:
    """(name, is a folder) of images and sub-folders by name; hidden ones and links to folders are left out.

    Each pass over the folder keeps the next names alone, so that memory does not depend on how many there are.
    """
    last: Place | None = None
    while batch := heapq.nsmallest(_NAMES_A_PASS, _entries_after(folder, last, passed_over)):
        yield from ((place[-1], is_folder) for place, is_folder in batch)
        last = batch[-1][0]


def _entries_after(folder: str, last: Place | None, passed_over: PassedOver) -> Iterator[tuple[Place, bool]]:
    with os.scandir(folder) as entries:
        for entry in entries:
            is_hidden, is_folder = entry.name.startswith("."), entry.is_dir(follow_symlinks=False)
            is_image = not is_hidden and os.path.splitext(entry.name)[1].lower() in IMAGE_SUFFIXES
            leads_to_folder = _leads_to_folder(entry)
            if last is None and leads_to_folder and not is_folder:  # in the first pass alone
                passed_over.link(entry.name)
            elif last is None and not is_image and not leads_to_folder:
                passed_over.file(entry.name)
            if (is_folder and not is_hidden) or (is_image and not leads_to_folder):
                place = by_number(entry.name)
                if last is None or place > last:
                    yield place, is_folder


def _leads_to_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:  # a link in a circle: an image that cannot be read
        return False


def _recorded_images(path: str, topics: Topics) -> Iterator[SourceImage]:
    from curio_serve.batch.images.recordings import Recording  # of an extra

    try:
        recording = Recording(path, topics)
    except UsageError as exc:
        yield SourceImage(path, path, error=str(exc))
        return
    yield from recording.images()


def _video_frames(path: str) -> Iterator[SourceImage]:
    """Frames as stored: a rotation noted in the video is not applied, because K belongs to the stored pixels."""
    try:
        check_regular(os.stat(path), path)
    except OSError as exc:
        yield SourceImage(path, path, error=f"cannot be read: {exc.strerror}")
        return
    number = 0
    for pixels, at_s in decoded_frames(path):
        name = f"{path}#{number}"
        if pixels is None:
            yield SourceImage(name, path, number, error="the video is damaged here: the frame cannot be decoded")
        else:
            yield SourceImage(name, path, number, pixels, time_s=at_s)
        number += 1
    if number == 0:
        yield SourceImage(
            path, path, error="not a video that can be decoded, or one without frames; convert it to H.264 in MP4"
        )
