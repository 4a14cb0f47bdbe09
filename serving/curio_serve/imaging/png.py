"""Reduces a PNG to what its pixels need, so that no decoder unfolds text or data that no pixel shows (W3C PNG 3).

A text chunk of 200 kB may unfold to 200 MB, and so may image data that goes on beyond the last row: a file of 27 MB
then costs 16 seconds.
"""

import struct
import zlib
from collections.abc import Iterator

from curio_serve.errors import ImageError

MAGIC = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # as stored, by colour type
_KEPT = (b"IHDR", b"PLTE", b"IDAT", b"IEND")
_HARMLESS_BYTES = 1 << 16  # of compressed image data: deflate unfolds them to 68 MB at most
_PIECE_BYTES = 1 << 14


def chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """(kind, start of the content, its length) of each chunk; the last one may reach beyond the data."""
    position = len(MAGIC)
    while position + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, position)
        yield data[position + 4 : position + 8], position + 8, length
        position += 12 + length


def pixels_only(data: bytes) -> bytes:
    """The PNG without chunks that its pixels do not need.

    Args:
        data: A whole PNG file, which :func:`~curio_serve.imaging.image_header.read_header` accepts.

    Raises:
        ImageError: A checksum does not fit, or the image data unfolds to more than twice what the declared pixels take.
    """
    found = list(chunks(data))
    view = memoryview(data)
    kept = [view[start - 8 : start + length + 4] for kind, start, length in found if kind in _KEPT]
    # The decoder would find that out, too, and print it to the process's standard error.
    if any(zlib.crc32(chunk[4:-4]) != int.from_bytes(chunk[-4:], "big") for chunk in kept):
        raise ImageError("the PNG is damaged: a checksum does not fit its content; send the file again")
    packed = [view[start : start + length] for kind, start, length in found if kind == b"IDAT"]
    if sum(map(len, packed)) > _HARMLESS_BYTES:
        _check_unfolded(packed, _unfolded_bytes(data))
    return data if len(kept) == len(found) else MAGIC + b"".join(kept)


def _unfolded_bytes(data: bytes) -> int:
    """Size of the image data that the header declares, without interlacing."""
    width, height, depth, color_type = struct.unpack_from(">IIBB", data, 16)
    return ((width * _CHANNELS[color_type] * depth + 7) // 8 + 1) * height


def _check_unfolded(packed: list[memoryview], expected: int) -> None:
    """Unfold the image data piece by piece, keeping none of it. Damaged data is left for the decoder to report."""
    inflater, num_bytes = zlib.decompressobj(), 0
    try:
        for content in packed:
            for start in range(0, len(content), _PIECE_BYTES):
                num_bytes += len(inflater.decompress(content[start : start + _PIECE_BYTES]))
                if num_bytes > 2 * expected:  # interlacing adds a few bytes a row
                    raise ImageError(
                        f"the PNG holds more image data than an image of its size has: at least {num_bytes} bytes, "
                        f"expected {expected}; save it again"
                    )
                if inflater.eof:
                    return
    except zlib.error:
        return
