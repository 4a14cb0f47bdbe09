"""Reads what an encoded image declares about itself, without decoding a pixel.

A decoder told to open a file of 140 kB may allocate 432 MB; so size, colour model, completeness and EXIF orientation
are read here first, and what is not acceptable never reaches the decoder.
"""

import struct
from dataclasses import dataclass
from typing import Literal

from curio_serve.errors import ImageError
from curio_serve.imaging.png import MAGIC, chunks

ImageFormat = Literal["jpeg", "png", "webp"]

_EXIF_ORIENTATION = 0x0112
_SOF_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_PROGRESSIVE = frozenset((0xC2, 0xC6, 0xCA, 0xCE))
_BARE_MARKERS = frozenset(range(0xD0, 0xD8)) | {0x01}
MAX_JPEG_SCANS = 64
# A block of 8x8 samples takes at least a Huffman code of one bit for its mean, and, unless the picture is progressive,
# another one for the rest. With arithmetic codes it may take less.
_HUFFMAN_BITS = {0xC0: 2, 0xC1: 2, 0xC2: 1}
_HEIC = (b"ftypheic", b"ftypheix", b"ftyphevc", b"ftypmif1", b"ftypmsf1")  # ISO 23008-12


@dataclass(frozen=True)
class Header:
    """The properties that the header of an image file declares."""

    format: ImageFormat
    """Format of the file."""
    width: int
    """Pixels as stored."""
    height: int
    """Pixels as stored."""
    num_channels: int
    """1 grey, 2 grey + alpha, 3 colour, 4 colour + alpha or CMYK."""
    orientation: int = 1
    """EXIF orientation 1 … 8; 1 without EXIF."""


def read_header(data: bytes) -> Header:
    """Read the declared size and kind of an encoded image and check that its end is there.

    Raises:
        ImageError: Empty, none of JPEG, PNG and WebP, damaged, or cut short.
    """
    if not data:
        raise ImageError("the image is empty (0 bytes); expected a JPEG, PNG or WebP file")
    try:
        if data[:3] == b"\xff\xd8\xff":
            return _read_jpeg(data)
        if data[:8] == MAGIC:
            return _read_png(data)
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            return _read_webp(data)
    except (struct.error, IndexError) as exc:
        raise ImageError(f"the image ends inside its header ({len(data)} bytes); send the whole file") from exc
    if data[4:12] in _HEIC:
        raise ImageError(
            "a HEIC picture, as telephones take them; expected JPEG, PNG or WebP: convert it, for example by "
            "heif-convert or ImageMagick"
        )
    raise ImageError(
        f"not a JPEG, PNG or WebP image: it starts with {data[:8].hex(' ')}; convert it or send raw pixels"
    )


def _read_jpeg(data: bytes) -> Header:
    """Walk the marker segments up to the first scan (ITU-T T.81, annex B)."""
    size: tuple[int, int, int] | None = None
    is_progressive, orientation, position, least_bytes = False, 1, 2, 0
    while True:
        marker, position = _next_marker(data, position)
        if marker in _BARE_MARKERS:
            continue
        if marker == 0xDA:
            break
        if marker == 0xD9:
            raise ImageError("the JPEG has no picture data: its end marker comes before a scan")
        (length,) = struct.unpack_from(">H", data, position)
        segment = data[position + 2 : position + length]
        if length < 2 or len(segment) != length - 2:
            raise ImageError(f"the JPEG ends inside a header segment ({len(data)} bytes); send the whole file")
        if marker in _SOF_MARKERS:
            precision, height, width, num_channels = struct.unpack_from(">BHHB", segment)
            if precision != 8:
                raise ImageError(f"the JPEG has {precision} bits a sample; expected 8: convert it")
            size = (width, height, num_channels)
            is_progressive = marker in _PROGRESSIVE
            least_bytes = _num_blocks(width, height, segment[6:]) * _HUFFMAN_BITS.get(marker, 0) // 8
        elif marker == 0xE1 and segment[:6] == b"Exif\x00\x00":
            orientation = exif_orientation(segment[6:])
        position += length
    if size is None:
        raise ImageError("the JPEG has no frame header before its first scan; the file is damaged")
    _check_jpeg_end(data, position)
    if len(data) - position < least_bytes:
        raise ImageError(
            f"the JPEG declares {size[0]}x{size[1]} pixels, which take at least {least_bytes} bytes, and has "
            f"{len(data) - position}; send the file again"
        )
    if is_progressive or data[position + 2] < size[2]:
        _check_jpeg_scans(data, position)
    return Header("jpeg", *size, orientation)


def _num_blocks(width: int, height: int, components: bytes) -> int:
    """Blocks of all components, whose sampling factors stand in the frame header (ITU-T T.81, A.1.1 and B.2.2)."""
    factors = [(code >> 4, code & 15) for code in components[1::3]]
    most = [max((pair[axis] for pair in factors), default=0) for axis in (0, 1)]
    if 0 in most:
        return 0
    return sum(-(-width * h // (8 * most[0])) * -(-height * v // (8 * most[1])) for h, v in factors)


def _next_marker(data: bytes, position: int) -> tuple[int, int]:
    if data[position] != 0xFF:
        raise ImageError(f"the JPEG is damaged: no marker at byte {position}; send the file again")
    while data[position] == 0xFF:
        position += 1
    return data[position], position + 1


def _check_jpeg_end(data: bytes, first_scan: int) -> None:
    """Refuse a picture without its end: decoders fill in grey.

    In entropy-coded data 0xFF is followed by 0 or a restart marker alone, so this byte pair is a true marker there.
    """
    if data.rfind(b"\xff\xd9", first_scan) < 0:
        raise ImageError(f"the JPEG is cut short: no end marker in its {len(data)} bytes; send the whole file")


def _check_jpeg_scans(data: bytes, first_scan: int) -> None:
    """Refuse absurdly many scans, each of which costs a pass over the picture.

    Decoders read further scans only in files that are progressive or whose first scan has not all components.
    """
    num_scans = 1 + data.count(b"\xff\xda", first_scan)
    if num_scans > MAX_JPEG_SCANS:
        raise ImageError(f"the JPEG has {num_scans} scans; at most {MAX_JPEG_SCANS} are accepted: save it as baseline")


def _read_png(data: bytes) -> Header:
    """Walk the chunks to IEND (W3C PNG, section 5)."""
    width, height, _depth, color_type = struct.unpack_from(">IIBB", data, 16)
    if data[12:16] != b"IHDR":
        raise ImageError("the PNG is damaged: its first chunk is not IHDR; send the file again")
    # 3 is a palette, decoded to colour.
    num_channels = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}.get(color_type)
    if num_channels is None:
        raise ImageError(f"the PNG is damaged: colour type {color_type} does not exist; send the file again")
    orientation, num_data_bytes = 1, 0
    for kind, start, length in chunks(data):
        if kind == b"IEND":
            if not num_data_bytes:
                raise ImageError("the PNG has no picture data (no IDAT chunk); the file is damaged")
            return Header("png", width, height, num_channels, orientation)
        if kind == b"acTL":
            raise ImageError("the PNG is an animation; expected a single picture")
        num_data_bytes += length if kind == b"IDAT" else 0
        if kind == b"eXIf":
            orientation = exif_orientation(data[start : start + length])
    raise ImageError(f"the PNG is cut short: no end chunk in its {len(data)} bytes; send the whole file")


def _read_webp(data: bytes) -> Header:
    """Read the first image chunk of a RIFF container (RFC 9649, section 2)."""
    (riff_length,) = struct.unpack_from("<I", data, 4)
    if len(data) < riff_length + 8:
        raise ImageError(f"the WebP is cut short: {len(data)} of {riff_length + 8} bytes; send the whole file")
    kind = data[12:16]
    if kind == b"VP8X":
        flags = data[20]
        if flags & 0x02:
            raise ImageError("the WebP is an animation; expected a single picture")
        width, height = 1 + int.from_bytes(data[24:27], "little"), 1 + int.from_bytes(data[27:30], "little")
        return Header("webp", width, height, 4 if flags & 0x10 else 3, _webp_orientation(data))
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return Header("webp", 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF), 4 if bits >> 28 & 1 else 3)
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return Header("webp", width & 0x3FFF, height & 0x3FFF, 3)
    raise ImageError(f"the WebP is damaged: its first chunk is {kind!r}; send the file again")


def _webp_orientation(data: bytes) -> int:
    position = 12
    while position + 8 <= len(data):
        (length,) = struct.unpack_from("<I", data, position + 4)
        if data[position : position + 4] == b"EXIF":
            return exif_orientation(data[position + 8 : position + 8 + length].removeprefix(b"Exif\x00\x00"))
        position += 8 + length + (length & 1)
    return 1


def exif_orientation(tiff: bytes) -> int:
    """Orientation 1 … 8 of an EXIF block (TIFF 6.0 header and first directory); 1 if it has none or is damaged."""
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None:
        return 1
    try:
        (directory,) = struct.unpack_from(f"{order}I", tiff, 4)
        (num_entries,) = struct.unpack_from(f"{order}H", tiff, directory)
        for entry in range(num_entries):
            tag, _type, _count, value = struct.unpack_from(f"{order}HHIH", tiff, directory + 2 + 12 * entry)
            if tag == _EXIF_ORIENTATION:
                return value if 1 <= value <= 8 else 1
    except struct.error:
        return 1
    return 1
