"""Images behind URLs, through fsspec: ``s3://``, ``gs://``, ``http://`` and ``https://``.

A request that fails for a while (a time-out, a broken connection, an answer 5xx) is made again a few times, each time
later. What stays wrong with one object (missing, refused) is an :class:`ImageError` about it. A store that does not
answer at all is :class:`Unavailable`, which ends the run: an error line would count as an answer, and the image would
not be tried again when the run goes on. Over HTTP every image may lie on another host, so there it is an ImageError.
"""

import errno
import hashlib
import os
import posixpath
import random
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeVar

from curio_serve.errors import ImageError, Unavailable, UsageError

T = TypeVar("T")
_URL = re.compile(r"[a-z][a-z0-9+.-]+://.")
_STORES, _WEB = ("s3", "gs"), ("http", "https")
_MAX_LIST_BYTES = 64 << 20
_CANNOT_BE_READ_AGAIN = (errno.EINVAL, errno.EFBIG, errno.ENAMETOOLONG)
_BUSY = (408, 429)  # of HTTP's 4xx, what another attempt may change


@dataclass(frozen=True)
class Patience:
    """How long to wait for a store."""

    timeout_s: float = 60.0
    """Seconds for one attempt."""
    num_attempts: int = 5
    """Number of attempts of a request, including the first."""
    first_wait_s: float = 0.5
    """Seconds before the second attempt. Each further wait is twice as long, plus a random part of up to a half."""


def is_url(path: str) -> bool:
    """Whether an argument is a URL rather than a path."""
    return _URL.match(path) is not None


def is_store(url: str) -> bool:
    """Whether a URL is in an object store, which can be listed and written."""
    return url.partition("://")[0] in _STORES


def check_scheme(url: str) -> None:
    """Refuse URLs of a kind that is not read.

    Raises:
        UsageError: It is none of those that are.
    """
    scheme = url.partition("://")[0]
    if scheme not in _STORES + _WEB:
        raise UsageError(f"{scheme}://: not supported; expected s3://, gs://, http:// or https://")


def place_and_query(url: str) -> tuple[str, str]:
    """A URL without its query, and that."""
    if is_store(url):  # whose keys may hold these characters
        return url, ""
    place, _, query = url.partition("#")[0].partition("?")
    return place, query


def path_of(url: str) -> str:
    """A relative path made of a URL, unique to it, for files such as drawings."""
    place, query = place_and_query(url)
    path, suffix = posixpath.splitext(posixpath.normpath(place.replace("://", "/")).lstrip("./"))
    return path + (f"-{hashlib.sha256(query.encode()).hexdigest()[:8]}" if query else "") + suffix


class RemoteFiles:
    """The files that a kind of URL names; safe to share between threads.

    Args:
        scheme: Of the URLs, such as ``s3``.
        patience: With their server.

    Raises:
        UsageError: The scheme is not supported, or the extra ``cloud`` is not installed.
    """

    def __init__(self, scheme: str, patience: Patience = Patience()) -> None:
        check_scheme(f"{scheme}://")
        try:
            import fsspec

            self._errors: tuple[type[Exception], ...] = (OSError, *_foreign_errors(scheme))
            # A listing that fsspec keeps would grow with the images, and hide what others write.
            self._files = fsspec.filesystem(scheme, use_listings_cache=False)
        except ImportError as exc:
            raise UsageError(f"{scheme}:// needs the extra cloud: pip install 'curio-pose[cloud]' ({exc})") from exc
        self._scheme, self._patience = scheme, patience

    def read(self, url: str, max_bytes: int) -> bytes:
        """The content of an object, as one request saw it: one that changes meanwhile is read as before or as after.

        Raises:
            ImageError: It is missing, refused or larger than allowed, or, over HTTP, its host does not answer.
            Unavailable: The store does not answer.
        """
        try:
            # one byte more, so that a larger object shows and is not loaded as a whole
            data = self._persist(url, lambda limit: self._files.cat_file(url, start=0, end=max_bytes + 1, **limit))
        except OSError as exc:
            raise ImageError(f"cannot be read: {_reason(exc)}") from exc
        except Unavailable as exc:
            if self._scheme in _WEB:
                raise ImageError(f"cannot be read: {exc}") from exc
            raise
        if len(data) > max_bytes:
            raise ImageError(f"cannot be read: more than {max_bytes} bytes")
        return data

    def names_in_list(self, url: str) -> Iterator[str]:
        """The URLs that a text object names, one a line; a name without scheme lies beside the list.

        Raises:
            UsageError: The list is missing, refused, or larger than 64 MiB.
            Unavailable: The store does not answer.
        """
        try:
            data = self.read(url, _MAX_LIST_BYTES)
        except ImageError as exc:
            raise UsageError(f"{url}: this list {exc}") from exc
        folder = re.split(r"[?#]", url)[0].rpartition("/")[0]
        for line in data.decode("utf-8", "surrogateescape").splitlines():
            if name := line.strip():
                yield name if is_url(name) else f"{folder}/{name}"

    def below(self, folder: str) -> Iterator[str]:
        """The URLs of all objects below a folder of a store, by name.

        S3 is asked for a page after another. Of Google's store one folder at a time is held in memory.

        Raises:
            UsageError: The bucket refuses, or one of S3 is missing; in Google's store a missing one is empty.
            Unavailable: The store does not answer.
        """
        pages = self._s3_pages(folder) if self._scheme == "s3" else self._folders(folder)
        try:
            for page in pages:
                yield from page
        except OSError as exc:
            raise UsageError(f"{folder}: cannot be listed: {_reason(exc)}") from exc

    def write(self, url: str, data: bytes) -> None:
        """Put an object, whole or not at all.

        Raises:
            OSError: The store refuses.
            Unavailable: The store does not answer.
        """
        self._persist(url, lambda limit: self._files.pipe_file(url, data, **limit))

    def remove(self, url: str) -> None:
        """Remove an object.

        Raises:
            OSError: The store refuses.
            Unavailable: The store does not answer.
        """
        self._persist(url, lambda _: self._files.rm_file(url))

    def _s3_pages(self, folder: str) -> Iterator[list[str]]:
        bucket, _, prefix = folder.removeprefix("s3://").partition("/")
        last = ""
        while True:
            ask = {"Bucket": bucket, "Prefix": prefix, "StartAfter": last}
            page = self._persist(folder, lambda limit: self._files.call_s3("list_objects_v2", **ask, **limit))  # noqa: B023
            keys = [entry["Key"] for entry in page.get("Contents", ())]
            yield [f"s3://{bucket}/{key}" for key in keys if not key.endswith("/")]
            if not page.get("IsTruncated"):
                return
            last = keys[-1]

    def _folders(self, folder: str) -> Iterator[list[str]]:
        try:
            entries = self._persist(folder, lambda limit: self._files.ls(folder, detail=True, **limit))
        except FileNotFoundError:  # nothing is there yet: a store has no folders
            return
        for entry in sorted(entries, key=lambda entry: entry["name"]):
            url = f"{self._scheme}://{entry['name']}"
            if entry["type"] != "directory":
                yield [url]
            elif url.rstrip("/") != folder.rstrip("/"):
                yield from self._folders(url.rstrip("/") + "/")

    def _persist(self, url: str, request: Callable[[dict[str, Any]], T]) -> T:
        """Make a request until it succeeds, fails for good, or patience ends.

        Raises:
            OSError: What another attempt would not change.
            Unavailable: All attempts failed.
        """
        patience = self._patience
        wait = patience.first_wait_s
        for attempt in range(1, patience.num_attempts + 1):
            try:
                return request({"timeout": patience.timeout_s})
            except self._errors as exc:
                if isinstance(exc, FileNotFoundError):
                    raise
                if _is_final(exc):
                    raise OSError(errno.EIO, _reason(exc)) from exc
                if attempt == patience.num_attempts:
                    raise Unavailable(
                        f"{url}: no answer after {attempt} attempts: {_reason(exc)}. Check the network and the store, "
                        "then run the same command again."
                    ) from exc
            time.sleep(wait * random.uniform(1, 1.5))
            wait *= 2
        raise AssertionError("a request has at least one attempt")


_opened = lru_cache(RemoteFiles)


def files_of(url: str) -> RemoteFiles:
    """The files of a URL's scheme, opened once a process.

    Raises:
        UsageError: As :class:`RemoteFiles`.
    """
    return _opened(url.partition("://")[0])


def _foreign_errors(scheme: str) -> tuple[type[Exception], ...]:
    """The exceptions, other than OSError, that the libraries raise.

    Raises:
        ImportError: They are not installed.
    """
    from aiohttp import ClientError

    if scheme == "s3":
        import s3fs  # noqa: F401
        from botocore.exceptions import BotoCoreError

        return ClientError, BotoCoreError
    if scheme == "gs":
        from gcsfs.retry import HttpError
        from google.auth.exceptions import GoogleAuthError

        return ClientError, HttpError, GoogleAuthError
    return ClientError, ValueError  # ValueError: a URL that is none


def _is_final(exc: Exception) -> bool:
    if isinstance(exc, FileNotFoundError | PermissionError | IsADirectoryError | ValueError):
        return True
    if type(exc).__name__ in ("NoCredentialsError", "DefaultCredentialsError", "PartialCredentialsError"):
        return True
    code = getattr(exc, "status", None) or getattr(exc, "code", None)
    if code is not None and str(code).isdecimal():
        return 400 <= int(code) < 500 and int(code) not in _BUSY
    return isinstance(exc, OSError) and exc.errno in _CANNOT_BE_READ_AGAIN


def _reason(exc: Exception) -> str:
    if isinstance(exc, FileNotFoundError):
        # Stores say in words that a bucket is missing; an object that is missing is told like a file.
        return str(exc) if "bucket" in str(exc) else os.strerror(errno.ENOENT)
    if isinstance(exc, TimeoutError):
        return "it did not answer in time"
    return (exc.strerror if isinstance(exc, OSError) and exc.strerror else str(exc)) or type(exc).__name__
