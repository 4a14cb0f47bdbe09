"""Decodes JPEGs, and refuses those that are damaged.

Where bytes are missing inside the picture, a lenient decoder fills in grey or shifts the rest, and prints a line to the
process's standard error. A pose that is read from such a picture is wrong.
"""

import re

import numpy as np
import simplejpeg

from curio_serve.errors import ImageError

_PADDING = re.compile(r"(\d+) extraneous bytes before marker 0xd9")
_MOST_PADDING = 8  # bytes that webcams leave between the picture and its end


def decoded_jpeg(data: bytes, width: int, height: int, reduction: int) -> np.ndarray:
    """Pixels of a JPEG, uint8 RGB [height / reduction, width / reduction, 3].

    Args:
        data: The file's bytes.
        width: That its header declares.
        height: That its header declares.
        reduction: 1, 2, 4 or 8, which divides both sides.

    Raises:
        ImageError: It is damaged.
    """
    try:
        return _decoded(data, width // reduction, height // reduction, strict=True)
    except ValueError as exc:
        padding = _PADDING.search(str(exc))
        if padding is None or int(padding[1]) > _MOST_PADDING:
            raise ImageError(f"the JPEG is damaged ({exc}); send the file again") from exc
    return _decoded(data, width // reduction, height // reduction, strict=False)


def _decoded(data: bytes, width: int, height: int, *, strict: bool) -> np.ndarray:
    """The pixels in the smallest scale that has as many; ``strict`` raises for what libjpeg only warns of."""
    pixels: np.ndarray = simplejpeg.decode_jpeg(data, "RGB", min_width=width, min_height=height, strict=strict)
    return pixels
