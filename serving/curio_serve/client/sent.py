"""Requests of a stream as they are sent: what their maker raises ends them, and is raised after the answers."""

from collections.abc import AsyncIterable, AsyncIterator, Iterable, Iterator
from types import TracebackType
from typing import Self

from curio_proto.v1.detector_pb2 import DetectRequest


class Sent:
    """The requests of one stream. gRPC would call what their iterator raises an unknown error, and drop answers."""

    def __init__(self) -> None:
        self._error: Exception | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> bool:
        """Keep an error for :meth:`raise_error`."""
        if not isinstance(error, Exception):
            return False
        self._error = error
        return True

    def each(self, requests: Iterable[DetectRequest]) -> Iterator[DetectRequest]:
        """The requests, up to an error."""
        with self:
            yield from requests

    async def each_async(self, requests: AsyncIterable[DetectRequest]) -> AsyncIterator[DetectRequest]:
        """The same for asyncio."""
        with self:
            async for request in requests:
                yield request

    def raise_error(self) -> None:
        """Raise what ended the requests, if anything did.

        Raises:
            Exception: What the iterator raised.
        """
        if self._error is not None:
            raise self._error
