"""Ctrl-C and SIGTERM: training finishes and saves the current step first; everything else stops at once."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Interrupted(KeyboardInterrupt):
    """A signal asked the process to end; a KeyboardInterrupt, so that no handler of errors swallows it."""

    signum: int
    """Number of the signal."""

    def __init__(self, signum: int) -> None:
        super().__init__(signal.Signals(signum).name)
        self.signum = signum

    @property
    def exit_status(self) -> int:
        """128 + signal number, the shell's convention: 130 for Ctrl-C, 143 for SIGTERM."""
        return 128 + self.signum


class Interruption:
    """Whether, and by which signal, this process was asked to end; see :func:`interruptible`."""

    signum: int | None
    """The signal that came, or None."""

    def __init__(self) -> None:
        self.signum = None
        self._deferred = False

    def receive(self, signum: int, frame: FrameType | None) -> None:
        """The signal handler.

        Raises:
            Interrupted: Signals are not deferred, or this is the second one.
        """
        again = self.signum is not None
        self.signum = signum
        if again or not self._deferred:
            raise Interrupted(signum)

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """Within the block the first signal only sets :attr:`signum`; a second one raises."""
        self._deferred = True
        try:
            yield
        finally:
            self._deferred = False


@contextmanager
def interruptible() -> Iterator[Interruption]:
    """Catch both signals within the block."""
    interruption = Interruption()
    before = {signum: signal.signal(signum, interruption.receive) for signum in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield interruption
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)
