"""Opens cameras and videos by what users type, and reads videos to their end."""

import os
from collections.abc import Iterator

import cv2
import numpy as np

_MOST_DIGITS = 6  # of a camera's number
_MOST_DAMAGED = 30  # frames in a row; after so many, nothing more is expected of a video
_WHOLE = 0.9  # of the frames, or of the time, that a video says it has: both are estimates in some files


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
    A video that ends long before it says it does has a damaged frame there.
    """
    capture = open_video(os.path.abspath(path))  # never the number of a camera
    rate, announced = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
    number, damaged, first_ms, at_ms, before_s = 0, 0, None, 0.0, 0.0
    try:
        while damaged <= _MOST_DAMAGED:
            is_read, pixels = capture.read()
            if not is_read:
                damaged += 1
                continue
            yield from [(None, None)] * damaged
            number, damaged = number + damaged, 0
            at_ms = capture.get(cv2.CAP_PROP_POS_MSEC)  # 0 of every frame where the video says nothing
            by_rate_s = number / rate if rate > 0 else None
            if first_ms is None:
                first_ms, before_s = at_ms, by_rate_s or 0.0  # of damaged frames at the very beginning
            by_video_s = before_s + (at_ms - first_ms) / 1000
            yield cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), by_video_s if at_ms > first_ms else by_rate_s
            number += 1
        is_short = rate > 0 and (at_ms - (first_ms or 0.0)) / 1000 < _WHOLE * announced / rate
        if is_short and 0 < number < _WHOLE * announced:
            yield None, None
    finally:
        capture.release()
