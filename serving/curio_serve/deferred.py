"""Errors of an iterable that wait for their turn: what was taken of it before comes first."""

from asyncio import CancelledError
from collections.abc import AsyncIterable, AsyncIterator, Iterable, Iterator
from types import TracebackType
from typing import Self, TypeVar

Item = TypeVar("Item")
_ENDS_ALL = (GeneratorExit, KeyboardInterrupt, SystemExit, CancelledError)  # which are no errors of an iterable


class DeferredError:
    """Holds back an error that ends an iterable, until the items before it are done with."""

    def __init__(self) -> None:
        self._error: BaseException | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> bool:
        """Keep an error for :meth:`raise_it`."""
        if isinstance(error, _ENDS_ALL):
            return False
        self._error = error
        return True

    def each(self, items: Iterable[Item]) -> Iterator[Item]:
        """The items, up to an error."""
        with self:
            yield from items

    async def each_async(self, items: AsyncIterable[Item]) -> AsyncIterator[Item]:
        """What :meth:`each` does, for asyncio."""
        with self:
            async for item in items:
                yield item

    def raise_it(self) -> None:
        """Raise what ended the items, if anything did.

        Raises:
            BaseException: What the iterable raised; not all that native code raises is an Exception.
        """
        if self._error is not None:
            raise self._error
