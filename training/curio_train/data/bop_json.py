"""JSON files read with a name for every value, so that an error says which file and which key."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from curio_serve.files import read_json

from curio_train.errors import DataError

_MAX_BYTES = 1 << 28


@dataclass(frozen=True)
class Record:
    """A JSON value and where it comes from. Keys are paths: ``"3/0/cam_K"``, with list positions as numbers."""

    value: Any
    where: str

    def entry(self, key: str) -> "Record":
        """The value under that key.

        Raises:
            DataError: There is none.
        """
        value = self.value
        for part in key.split("/"):
            if isinstance(value, dict) and part in value:
                value = value[part]
            elif isinstance(value, list) and part.isdecimal() and int(part) < len(value):
                value = value[int(part)]
            else:
                raise DataError(f"{self.where}, {key}: found no such entry")
        return Record(value, f"{self.where}, {key}")

    def keys(self) -> list[str]:
        """The keys of an object that is indexed by image numbers.

        Raises:
            DataError: It is not such an object.
        """
        if not isinstance(self.value, dict) or not all(key.isdecimal() for key in self.value):
            raise DataError(f"{self.where}: found {_short(self.value)}, expected an object with image numbers as keys")
        return list(self.value)

    def length(self, key: str = "") -> int:
        """Length of the list under that key, or of this one; 0 where an object lacks the key.

        Raises:
            DataError: It is not a list.
        """
        value = self.value
        if key:
            value = value.get(key, []) if isinstance(value, dict) else None
        if not isinstance(value, list):
            raise DataError(f"{self.where}{key and f', {key}'}: found {_short(value)}, expected a list")
        return len(value)

    def numbers(self, key: str, count: int) -> list[float]:
        """A given count of finite numbers: a list, or the bare number where one is wanted.

        Raises:
            DataError: Something else is there.
        """
        found = self.entry(key)
        values = found.value if isinstance(found.value, list) else [found.value]
        numbers = [float(value) for value in values if _is_finite(value)]
        if len(numbers) != count or len(values) != count:
            raise DataError(f"{found.where}: found {_short(found.value)}, expected {count} finite number(s)")
        return numbers

    def integer(self, key: str) -> int:
        """A whole number.

        Raises:
            DataError: Something else is there.
        """
        found = self.entry(key)
        if not isinstance(found.value, int) or isinstance(found.value, bool):
            raise DataError(f"{found.where}: found {_short(found.value)}, expected a whole number")
        return found.value


def read_records(path: Path) -> Record:
    """The content of a JSON file.

    Raises:
        DataError: The file is missing or not JSON.
    """
    try:
        return Record(read_json(path, _MAX_BYTES), str(path))
    except OSError as exc:
        raise DataError(f"{path}: cannot be read ({exc.strerror}); is the data set complete?") from exc
    except ValueError as exc:
        raise DataError(f"{path}: not JSON ({exc}); download it again") from exc


def _is_finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
