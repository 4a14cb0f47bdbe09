"""Takes a large field out of a serialized message without copying it.

A protobuf message copies its bytes when it is parsed and again whenever they are looked at: for a picture, two copies
of what is decoded once. Format: https://protobuf.dev/programming-guides/encoding.
"""

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_MAX_VARINT_BITS = 64


def take_out(data: bytes, number: int) -> tuple[bytes, memoryview] | None:
    """Split a message into the rest and the value of its field ``number``, a view of ``data``.

    Returns:
        None where the field is not there exactly once as bytes, or the message has not the usual form: what that means
        is for protobuf to say.
    """
    position, found = 0, None
    try:
        while position < len(data):
            begin = position
            key, position = _varint(data, position)
            kind = key & 7
            if kind == _BYTES:
                length, position = _varint(data, position)
                if key >> 3 == number:
                    if found:
                        return None
                    found = begin, position, position + length
                position += length
            elif kind == _VARINT:
                _, position = _varint(data, position)
            elif kind in (_FIXED64, _FIXED32):
                position += 8 if kind == _FIXED64 else 4
            else:
                return None
    except IndexError:
        return None
    if position != len(data) or found is None:
        return None
    begin, value, end = found
    return data[:begin] + data[end:], memoryview(data)[value:end]


def _varint(data: bytes, position: int) -> tuple[int, int]:
    """An integer, seven bits a byte, and where it ends; IndexError where none does."""
    number = shift = 0
    while (byte := data[position]) >= 0x80:
        number |= (byte & 0x7F) << shift
        shift += 7
        position += 1
        if shift >= _MAX_VARINT_BITS:
            raise IndexError
    return number | byte << shift, position + 1
