"""Runs a function in a second process, beside the first, for as long as the first stays in a context."""

import multiprocessing
import signal
from collections.abc import Callable
from functools import cached_property
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Generic, Self, TypeVar

import torch

from curio_train.errors import CurioError, WorkError

Result = TypeVar("Result")


class SecondProcess(Generic[Result]):
    """A call of a function that another process runs, with one thread; it ends with the context at the latest."""

    def __init__(self, function: Callable[..., Result], *arguments: object) -> None:
        """Begin nothing yet.

        Args:
            function: Of a module; what it returns or raises can be pickled.
            arguments: Of the call.
        """
        self._call = function, arguments
        self._receiver: Connection | None = None
        self._has_sent = False

    def __enter__(self) -> Self:
        context = multiprocessing.get_context("spawn")
        self._receiver, sender = context.Pipe(duplex=False)
        # A daemon ends with this process, however that ends.
        self._process = context.Process(target=_run, args=(*self._call, sender), daemon=True)
        self._process.start()
        sender.close()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._receiver is not None:
            self._receiver.close()
            if not self._has_sent:  # ended from here it would leave a warning of Python's behind
                self._process.terminate()
            self._process.join()
            self._receiver = None

    @cached_property
    def result(self) -> Result | CurioError:
        """What the function returned, or the error that it raised; waits for it."""
        ended = WorkError("a second process was ended before it was done; is there too little memory?")
        if self._receiver is None:
            return ended
        try:
            found: Result | CurioError = self._receiver.recv()
        except (EOFError, OSError):  # the second where it was ended while it sent
            return ended
        self._has_sent = True  # it needs some seconds to end, which nobody waits for here
        return found


def _run(function: Callable[..., object], arguments: tuple[object, ...], sender: Connection) -> None:
    """What the second process does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to both; the first process ends this one
    torch.set_num_threads(1)
    try:
        found = function(*arguments)
    except CurioError as exc:
        found = exc
    sender.send(found)
