"""Images of several calls in one run of the network, for devices on which a batch costs little more than an image.

Nobody waits for company: a call that finds the network idle runs at once. Those that come meanwhile are gathered, and
the first of them runs them all when the network is free again. So batches grow with the load by themselves, without a
delay to be tuned, and without a thread of their own.
"""

import queue
import threading
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from curio_serve.errors import CurioError, InternalError

Run = Callable[[np.ndarray], Sequence[np.ndarray]]


class _Share:
    """One call's images, and the answer to them: outputs, an error, or None where it is this call's turn to run."""

    def __init__(self, images: np.ndarray) -> None:
        self.images = images
        self.answer: queue.SimpleQueue[Sequence[np.ndarray] | CurioError | None] = queue.SimpleQueue()


class Batcher:
    """Runs a network for many threads, several calls at a time.

    Args:
        run: The network, images [batch, ...] to outputs [batch, ...].
        max_batch: Most images in a run, unless one call alone brings more.
    """

    def __init__(self, run: Run, max_batch: int) -> None:
        self._run, self._max_batch = run, max_batch
        self._lock = threading.Lock()
        self._waiting: deque[_Share] = deque()
        self._is_busy = False

    def __call__(self, images: np.ndarray) -> Sequence[np.ndarray]:
        """Outputs for these images alone.

        Raises:
            CurioError: The run they were part of failed.
        """
        own = _Share(images)
        with self._lock:
            self._waiting.append(own)
            is_first, self._is_busy = not self._is_busy, True
        answer = None if is_first else own.answer.get()
        if answer is None:
            self._lead()
            answer = own.answer.get()
        if isinstance(answer, CurioError):
            raise answer
        assert answer is not None
        return answer

    def _lead(self) -> None:
        """Run what waits, one's own first, and pass the network on."""
        with self._lock:
            shares = [self._waiting.popleft()]
            num_images = len(shares[0].images)
            while self._waiting and num_images + len(self._waiting[0].images) <= self._max_batch:
                shares.append(self._waiting.popleft())
                num_images += len(shares[-1].images)
        outcome: Sequence[np.ndarray] | CurioError = InternalError("the thread that ran the network was ended")
        try:
            outcome = self._run(np.concatenate([share.images for share in shares]) if shares[1:] else shares[0].images)
        except CurioError as exc:
            outcome = exc
        finally:
            with self._lock:
                self._is_busy = bool(self._waiting)
                if self._waiting:
                    self._waiting[0].answer.put(None)
            _hand_out(shares, outcome)


def _hand_out(shares: list[_Share], outcome: Sequence[np.ndarray] | CurioError) -> None:
    start = 0
    for share in shares:
        end = start + len(share.images)
        share.answer.put(outcome if isinstance(outcome, CurioError) else [value[start:end] for value in outcome])
        start = end
