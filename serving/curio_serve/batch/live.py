"""Detects in a camera's or a video's frames as they come, and shows them in the browser (viser)."""

import sys
import threading
import time
from collections import deque
from types import TracebackType
from typing import Self

import cv2
import numpy as np
import viser
from curio_proto.v1.detector_pb2 import Detection

from curio_serve.batch.estimators import Estimator
from curio_serve.errors import RequestError, UsageError
from curio_serve.imaging.video import open_video
from curio_serve.ports import port_fault

_RECENT = 30  # frames that the rates are means of


class LatestFrame:
    """Reads a video source in a thread and keeps only its newest frame."""

    num_read: int
    """Frames read so far."""
    num_taken: int
    """Number of these frames that :meth:`take` returned; the others were dropped."""

    def __init__(self, source: str) -> None:
        """Open the source.

        Args:
            source: Number of a camera, a video file, or a URL that OpenCV opens, such as rtsp://….

        Raises:
            UsageError: It cannot be opened.
        """
        self._capture = open_video(source)
        if not self._capture.isOpened():
            raise UsageError(f"--video {source}: cannot be opened; expected a camera's number, a video file or a URL")
        is_recorded = self._capture.get(cv2.CAP_PROP_FRAME_COUNT) > 0  # what comes live does not say how long it is
        self._period_s = 1 / (self._capture.get(cv2.CAP_PROP_FPS) or 30.0) if is_recorded else 0.0
        self.num_read = self.num_taken = 0
        self._frame: np.ndarray | None = None
        self._news, self._ended = threading.Condition(), False
        self._thread = threading.Thread(target=self._read, name="video", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._ended = True
        self._thread.join()
        self._capture.release()

    def take(self) -> np.ndarray | None:
        """The newest frame that was not taken yet, uint8 RGB [height, width, 3]; waits for it. None at the end."""
        with self._news:
            self._news.wait_for(lambda: self._frame is not None or self._ended)
            frame, self._frame = self._frame, None
            self.num_taken += frame is not None
        return frame

    def _read(self) -> None:
        """Read frame after frame: as they come, or of a recorded video no faster than it was recorded."""
        due = time.monotonic()
        while not self._ended:
            is_read, pixels = self._capture.read()
            if not is_read:
                break
            with self._news:
                self._frame, self.num_read = cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), self.num_read + 1
                self._news.notify()
            due = max(due + self._period_s, time.monotonic() - self._period_s)
            time.sleep(max(0.0, due - time.monotonic()))
        with self._news:
            self._ended = True
            self._news.notify()


def show_live(estimator: Estimator, source: str, host: str, port: int) -> int:
    """Show overlays until the video ends or a signal comes.

    Args:
        estimator: Detects in each frame.
        source: See :class:`LatestFrame`.
        host: Address to listen on.
        port: To listen on.

    Returns:
        Number of frames that were shown.

    Raises:
        UsageError: The source cannot be opened, or the address cannot be listened on.
        ServiceError: The server that detects is out of reach.
    """
    if fault := port_fault(host, port):
        raise UsageError(fault)
    with LatestFrame(source) as frames:
        page = viser.ViserServer(host=host, port=port, label="curio-detect", verbose=False)
        page.gui.configure_theme(show_share_button=False)
        figures = page.gui.add_markdown("waiting for a frame")
        print(f"curio-detect: http://{host}:{port} shows {source}; Ctrl-C ends it", file=sys.stderr, flush=True)
        times: deque[float] = deque(maxlen=_RECENT)
        try:
            while (pixels := frames.take()) is not None:
                begin = time.perf_counter()
                try:
                    drawn, found = estimator.overlay(pixels)
                    text = "\n".join(map(_line, found)) or "nothing found"
                except RequestError as exc:
                    drawn, text = pixels, f"**error**: {exc}"
                spent_ms = 1000 * (time.perf_counter() - begin)
                times.append(time.monotonic())
                page.scene.set_background_image(drawn, format="jpeg")
                figures.content = f"{_rates(times, spent_ms, frames)}\n\n{text}"
        finally:
            page.stop()
    num_dropped = frames.num_read - frames.num_taken
    print(f"curio-detect: {frames.num_taken} frames shown, {num_dropped} dropped", file=sys.stderr)
    return frames.num_taken


def _rates(times: deque[float], spent_ms: float, frames: LatestFrame) -> str:
    rate = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else 0.0
    dropped = frames.num_read - frames.num_taken
    return f"**{rate:.1f} frames a second**, {spent_ms:.0f} ms a frame, {dropped} of {frames.num_read} frames dropped"


def _line(detection: Detection) -> str:
    x, y, z = (1000 * value for value in detection.translation_m)
    return f"* {detection.object}: confidence {detection.confidence:.2f}, at {x:.0f}, {y:.0f}, {z:.0f} mm"
