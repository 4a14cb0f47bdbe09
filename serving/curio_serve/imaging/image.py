"""Decodes images, and refuses what is not acceptable before decoding.

All pixels are uint8 RGB [height, width, 3] as stored: EXIF rotation is applied only on request, because K belongs to
the stored pixels. Grey becomes three equal channels, 16 bits lose their low byte, alpha is dropped (colours as stored).
CMYK is refused: its colours depend on a profile.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from curio_serve.errors import ImageError
from curio_serve.imaging.image_header import Header, read_header
from curio_serve.imaging.jpeg import decoded_jpeg
from curio_serve.imaging.png import pixels_only

MIN_SIDE_PX = 16
MAX_PIXELS = 1 << 25  # 33.5 million: 8K video fits
MAX_FILE_BYTES = 1 << 28  # more than so many pixels of 8 bytes take without compression
RawFormat = Literal["RGB8", "BGR8", "GRAY8"]

_QUARTER_TURNS = {1: 0, 3: 2, 6: 1, 8: 3}  # EXIF orientation to clockwise quarter turns


@dataclass(frozen=True)
class Frame:
    """A decoded image."""

    pixels: np.ndarray
    """uint8 RGB [height / reduction, width / reduction, 3]."""
    width: int
    """Width of the image in full size, to which K belongs."""
    height: int
    """Height of the image in full size, to which K belongs."""
    reduction: int = 1
    """1, 2, 4 or 8: how much smaller than the image the pixels were decoded."""
    quarter_turns: int = 0
    """Clockwise turns applied to the stored pixels; K has to be turned with them."""


def check_size(width: int, height: int, max_pixels: int = MAX_PIXELS) -> None:
    """Refuse sizes that cannot be a camera's frame.

    Raises:
        ImageError: A side under 16 pixels, or more pixels than allowed.
    """
    if min(width, height) < MIN_SIDE_PX:
        raise ImageError(f"the image is {width}x{height} pixels; each side needs at least {MIN_SIDE_PX}")
    if width * height > max_pixels:
        raise ImageError(
            f"the image is {width}x{height} = {width * height} pixels; at most {max_pixels} are accepted (max-pixels): "
            "shrink it"
        )


def open_header(data: bytes, max_pixels: int = MAX_PIXELS) -> Header:
    """The header of an encoded image, after checking that the image may be decoded.

    Raises:
        ImageError: Says what is wrong with it.
    """
    header = read_header(data)
    if header.format == "jpeg" and header.num_channels not in (1, 3):
        raise ImageError("the JPEG is CMYK, whose colours depend on a profile; expected RGB or grey: convert it")
    check_size(header.width, header.height, max_pixels)
    return header


def decode(
    data: bytes,
    *,
    header: Header | None = None,
    max_pixels: int = MAX_PIXELS,
    max_reduction: int = 1,
    apply_exif_rotation: bool = False,
) -> Frame:
    """Decode a JPEG, PNG or WebP image.

    Args:
        data: The file's bytes.
        header: From :func:`open_header`, if the caller has it already.
        max_pixels: Most pixels accepted, checked before anything is decoded.
        max_reduction: 1, 2, 4 or 8: a JPEG may be decoded this much smaller, which costs far less. The largest such
            number that divides both sides is used, so that the scale is exact.
        apply_exif_rotation: Turn the pixels as EXIF says.

    Raises:
        ImageError: Says what is wrong with it.
    """
    header = header or open_header(data, max_pixels)
    quarter_turns = quarter_turns_of(header) if apply_exif_rotation else 0
    reduction = _reduction(header, max_reduction)
    pixels = _decode_pixels(data, header, reduction)
    if quarter_turns:
        pixels = np.ascontiguousarray(np.rot90(pixels, -quarter_turns))
    width, height = (header.height, header.width) if quarter_turns % 2 else (header.width, header.height)
    return Frame(pixels, width, height, reduction, quarter_turns)


def quarter_turns_of(header: Header) -> int:
    """Clockwise quarter turns that EXIF asks for.

    Raises:
        ImageError: It asks for a mirror image.
    """
    if header.orientation not in _QUARTER_TURNS:
        raise ImageError(
            f"EXIF orientation {header.orientation} mirrors the image, which no camera does; decode it as stored, "
            "without EXIF rotation"
        )
    return _QUARTER_TURNS[header.orientation]


def _reduction(header: Header, max_reduction: int) -> int:
    if header.format != "jpeg":
        return 1
    fitting = (r for r in (8, 4, 2) if r <= max_reduction and header.width % r == 0 and header.height % r == 0)
    return next(fitting, 1)


def _decode_pixels(data: bytes, header: Header, reduction: int) -> np.ndarray:
    if header.format == "jpeg":
        pixels = decoded_jpeg(data, header.width, header.height, reduction)
    else:
        pixels = _decode_others(data, header)
    expected = (header.height // reduction, header.width // reduction, 3)
    if pixels.shape != expected or pixels.dtype != np.uint8:
        raise ImageError(f"the {header.format.upper()} declares {expected} and holds {pixels.shape}; it is damaged")
    return pixels


def _decode_others(data: bytes, header: Header) -> np.ndarray:
    buffer = np.frombuffer(pixels_only(data) if header.format == "png" else data, np.uint8)
    try:
        pixels = cv2.imdecode(buffer, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as exc:
        raise ImageError(f"the {header.format.upper()} cannot be decoded: {exc.err}; send the file again") from exc
    if pixels is None:
        raise ImageError(f"the {header.format.upper()} is damaged and cannot be decoded; send the file again")
    return pixels


def from_raw(
    data: bytes, raw_format: RawFormat, width: int, height: int, stride: int = 0, *, max_pixels: int = MAX_PIXELS
) -> Frame:
    """A frame from pixels without an encoding.

    Args:
        data: Rows from top to bottom.
        raw_format: Order of the channels.
        width: Pixels.
        height: Pixels.
        stride: Bytes from one row to the next; 0 for rows without padding.
        max_pixels: Most pixels accepted.

    Raises:
        ImageError: Size, stride and number of bytes do not fit together.
    """
    check_size(width, height, max_pixels)
    num_channels = 1 if raw_format == "GRAY8" else 3
    row_bytes = width * num_channels
    stride = stride or row_bytes
    expected = stride * (height - 1) + row_bytes
    if stride < row_bytes:
        raise ImageError(
            f"raw image: stride {stride} is shorter than a row of {row_bytes} bytes ({width} {raw_format} pixels)"
        )
    if len(data) not in (expected, stride * height):
        raise ImageError(
            f"raw image: {len(data)} bytes; {width}x{height} {raw_format} with stride {stride} takes {expected} "
            f"or {stride * height}"
        )
    rows = np.lib.stride_tricks.as_strided(
        np.frombuffer(data, np.uint8), (height, width, num_channels), (stride, num_channels, 1), writeable=False
    )
    if raw_format == "GRAY8":
        return Frame(np.repeat(rows, 3, axis=2), width, height)
    pixels = rows[:, :, ::-1] if raw_format == "BGR8" else rows
    return Frame(np.ascontiguousarray(pixels), width, height)
