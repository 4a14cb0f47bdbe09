"""Opens cameras and videos by what users type."""

import cv2

_MOST_DIGITS = 6  # of a camera's number


def open_video(source: str) -> cv2.VideoCapture:
    """Open a video or a camera with OpenCV; ask the result whether it could be opened.

    Args:
        source: Number of a camera, a video file, or a URL such as rtsp://….
    """
    is_number = source.isascii() and source.isdigit() and len(source) <= _MOST_DIGITS
    return cv2.VideoCapture(int(source) if is_number else source)
