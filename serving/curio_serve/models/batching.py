"""Runs the network once for the images of several calls, for devices where a batch costs little more than an image.

No call waits for others: one that finds the network idle runs at once. Calls that arrive meanwhile queue up, and the
first of them runs them all when the network is free again. So batches grow with the load, without a delay to tune and
without a thread of their own.
"""

import queue
import threading
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from curio_serve.errors import CurioError, InternalError

Run = Callable[[np.ndarray], Sequence[np.ndarray]]


class _Call:
    """One call's images, and the answer to them: outputs, an error, or None to tell the call to run the network."""

    def __init__(self, images: np.ndarray) -> None:
        self.images = images
        self.answer: queue.SimpleQueue[Sequence[np.ndarray] | CurioError | None] = queue.SimpleQueue()


class Batcher:
    """Runs a network for many threads, several calls at a time.

    Args:
        run: The network, images [batch, ...] to outputs [batch, ...].
        max_batch: Largest number of images in a run, unless one call alone has more.
    """

    def __init__(self, run: Run, max_batch: int) -> None:
        self._run, self._max_batch = run, max_batch
        self._lock = threading.Lock()
        self._waiting: deque[_Call] = deque()
        self._is_busy = False

    def __call__(self, images: np.ndarray) -> Sequence[np.ndarray]:
        """The network's outputs for these images.

        Raises:
            CurioError: The run that these images were part of failed.
        """
        own = _Call(images)
        with self._lock:
            self._waiting.append(own)
            is_first, self._is_busy = not self._is_busy, True
        answer = None if is_first else own.answer.get()
        if answer is None:
            self._run_waiting()
            answer = own.answer.get()
        if isinstance(answer, CurioError):
            raise answer
        assert answer is not None
        return answer

    def _run_waiting(self) -> None:
        """Run all waiting calls, our own first; then wake the next one in the queue to run."""
        with self._lock:
            calls = [self._waiting.popleft()]
            num_images = len(calls[0].images)
            while self._waiting and num_images + len(self._waiting[0].images) <= self._max_batch:
                calls.append(self._waiting.popleft())
                num_images += len(calls[-1].images)
        outcome: Sequence[np.ndarray] | CurioError = InternalError("the thread that ran the network was ended")
        try:
            outcome = self._run(np.concatenate([call.images for call in calls]) if calls[1:] else calls[0].images)
        except CurioError as exc:
            outcome = exc
        finally:
            with self._lock:
                self._is_busy = bool(self._waiting)
                if self._waiting:
                    self._waiting[0].answer.put(None)
            _hand_out(calls, outcome)


def _hand_out(calls: list[_Call], outcome: Sequence[np.ndarray] | CurioError) -> None:
    start = 0
    for call in calls:
        end = start + len(call.images)
        call.answer.put(outcome if isinstance(outcome, CurioError) else [value[start:end] for value in outcome])
        start = end
