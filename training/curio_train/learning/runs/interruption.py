"""Ctrl-C and SIGTERM: while training, the step at hand is finished and saved first; elsewhere they stop at once."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Interrupted(KeyboardInterrupt):
    """A signal asked the process to end. Not an error: nothing in between may swallow it.

    Attributes:
        signum: Which signal.
    """

    def __init__(self, signum: int) -> None:
        super().__init__(signal.Signals(signum).name)
        self.signum = signum

    @property
    def exit_status(self) -> int:
        """128 + signal number, the shell's convention: 130 for Ctrl-C, 143 for SIGTERM."""
        return 128 + self.signum


class Interruption:
    """Whether, and by which signal, this process was asked to end; see :func:`interruptible`.

    Attributes:
        signum: The signal that came, or None.
    """

    def __init__(self) -> None:
        self.signum: int | None = None
        self._waits = False

    def receive(self, signum: int, frame: FrameType | None) -> None:
        """The signal handler.

        Raises:
            Interrupted: Nobody asked for a delay, or this is the second signal.
        """
        again = self.signum is not None
        self.signum = signum
        if again or not self._waits:
            raise Interrupted(signum)

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """Within it the first signal only sets :attr:`signum`; a second one still stops at once."""
        self._waits = True
        try:
            yield
        finally:
            self._waits = False


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
