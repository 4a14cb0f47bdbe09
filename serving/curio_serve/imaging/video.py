"""Opens cameras and videos by what users type, and reads videos to their end."""

from collections.abc import Iterator

import cv2
import numpy as np

_MOST_DIGITS = 6  # of a camera's number
_MOST_DAMAGED = 30  # frames in a row; after so many, nothing more is expected of a video


def open_video(source: str) -> cv2.VideoCapture:
    """Open a video or a camera with OpenCV; ask the result whether it could be opened.

    Frames come as they are stored. A rotation noted in a video is not applied, because K belongs to the stored pixels.

    Args:
        source: Number of a camera, a video file, or a URL such as rtsp://….
    """
    is_number = source.isascii() and source.isdigit() and len(source) <= _MOST_DIGITS
    capture = cv2.VideoCapture(int(source) if is_number else source)
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return capture


def decoded_frames(path: str) -> Iterator[tuple[np.ndarray | None, float | None]]:
    """The frames of a video file, uint8 RGB [height, width, 3], as they are stored, or None for damaged ones.

    Beside each: the seconds since the first frame, by the video's own times or else by its frame rate; None: unknown.
    """
    capture = open_video(path)
    number, damaged, times = 0, 0, _Times(capture)
    try:
        while damaged <= _MOST_DAMAGED:
            is_read, pixels = capture.read()
            if not is_read:
                damaged += 1
                continue
            yield from [(None, None)] * damaged
            number, damaged = number + damaged, 0
            yield cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), times.of(number)
            number += 1
    finally:
        capture.release()


class _Times:
    """When a video's frames were taken."""

    def __init__(self, capture: cv2.VideoCapture) -> None:
        self._capture, self._rate = capture, capture.get(cv2.CAP_PROP_FPS)
        self._first_s = self._last_s = 0.0

    def of(self, number: int) -> float | None:
        """Of the frame that was read last, with this number: seconds since the first."""
        at_s = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        if number == 0:
            self._first_s = self._last_s = at_s
            return 0.0
        if at_s > self._last_s:
            self._last_s = at_s
            return at_s - self._first_s
        return number / self._rate if self._rate > 0 else None
