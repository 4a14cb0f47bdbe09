"""Limits how many fields a message has on the wire, before it is parsed.

Two bytes on the wire unfold to a hundred bytes or more of memory: a message of 32 MB that is nothing but empty elements
of a repeated field becomes gigabytes. So the elements are counted first; the contents of strings and bytes are skipped.
"""

from functools import cache

from google.protobuf.descriptor import Descriptor, FieldDescriptor

from curio_serve.errors import ArgumentError

MAX_FIELDS = 4096
MAX_NUMBERS = 1 << 20
_VARINT, _FIXED64, _BYTES, _GROUP_BEGIN, _GROUP_END, _FIXED32 = range(6)
_WIDTHS = {FieldDescriptor.TYPE_DOUBLE: 8, FieldDescriptor.TYPE_FLOAT: 4}
_TEXTS = (FieldDescriptor.TYPE_STRING, FieldDescriptor.TYPE_BYTES)


def check_counts(kind: Descriptor, data: bytes) -> None:
    """Refuse a message that would unfold to far more memory than its own length.

    Bytes that are no message pass; the parser refuses them.

    Raises:
        ArgumentError: It has more than MAX_FIELDS fields and elements, or MAX_NUMBERS packed numbers.
    """
    _Scan(data).message(kind, 0, len(data))


class _Scan:
    """One walk over a message."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._num_fields = self._num_numbers = 0

    def message(self, kind: Descriptor, position: int, end: int) -> None:
        """Count the fields between two positions; stops where no field can be read."""
        data, fields = self._data, _fields(kind)
        while position < end:
            self._num_fields += 1
            if self._num_fields > MAX_FIELDS:
                raise ArgumentError(f"the message has more than {MAX_FIELDS} fields and elements, which is the limit")
            tag, position = _varint(data, position, end)
            wire_type = tag & 7
            if wire_type == _BYTES:
                length, position = _varint(data, position, end)
                if length > end - position:
                    return
                content = fields.get(tag >> 3)
                if isinstance(content, Descriptor):
                    self.message(content, position, position + length)
                elif content:
                    self._add_numbers(length // content)
                position += length
            elif wire_type == _VARINT:
                position = _varint(data, position, end)[1]
            elif wire_type in (_FIXED64, _FIXED32):
                position += 8 if wire_type == _FIXED64 else 4
            elif wire_type not in (_GROUP_BEGIN, _GROUP_END):
                return

    def _add_numbers(self, number: int) -> None:
        self._num_numbers += number
        if self._num_numbers > MAX_NUMBERS:
            raise ArgumentError(
                f"the message has {self._num_numbers} numbers in lists; at most {MAX_NUMBERS} are accepted: "
                "send pixels as bytes"
            )


@cache
def _fields(kind: Descriptor) -> dict[int, Descriptor | int]:
    """Each field's kind of message, or for fields that hold numbers the fewest bytes of one number."""
    return {
        field.number: field.message_type or _WIDTHS.get(field.type, 1)
        for field in kind.fields
        if field.type not in _TEXTS
    }


def _varint(data: bytes, position: int, end: int) -> tuple[int, int]:
    """A number and the position behind it; the end if there is none."""
    value = shift = 0
    while position < end and shift < 64:
        byte = data[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
        shift += 7
    return 0, end
