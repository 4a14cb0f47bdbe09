"""Colours of vertices as fractions: files that have them from 0 to 255 are refused, because trimesh would clip them."""

import re
from pathlib import Path

import numpy as np

from curio_train.errors import MeshError

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_OBJ_COLORS = re.compile(rb"^v((?:[ \t]+[^\s]+){3})[ \t]+([^\s]+)[ \t]+([^\s]+)[ \t]+([^\s]+)[ \t]*\r?$", re.MULTILINE)
_VERTICES = re.compile(rb"element vertex (\d+)\s+((?:(?:property|comment)[^\n]*\n)+)")
_CHANNELS = ("red", "green", "blue")
_LARGEST = 1.01


def refuse_bytes_as_fractions(path: Path, content: bytes, kind: str) -> None:
    """Refuse colours of vertices above 1 that are written as floating-point numbers.

    Args:
        path: The file, for errors.
        content: Its content.
        kind: Its suffix; only ``obj`` and ``ply`` have such colours.

    Raises:
        MeshError: One is.
        ValueError: The file is damaged.
    """
    largest = _of_obj(content) if kind == "obj" else _of_ply(content) if kind == "ply" else 0.0
    if largest > _LARGEST:
        raise MeshError(
            f"{path}: its vertices have colours up to {largest:g}, written as floating-point numbers; expected 0 to 1, "
            "or whole numbers from 0 to 255"
        )


def _of_obj(content: bytes) -> float:
    colors = [[float(value) for value in found.groups()[1:]] for found in _OBJ_COLORS.finditer(content)]
    return max(map(max, colors), default=0.0)


def _of_ply(content: bytes) -> float:
    header, ends, data = content.partition(b"end_header")
    vertices = _VERTICES.search(header.replace(b"\r\n", b"\n"))
    if vertices is None or not ends or header.find(b"element") != header.find(b"element vertex"):
        return 0.0
    lines = [line.split() for line in vertices[2].decode("ascii", "replace").splitlines()]
    fields = [(line[-1], _TYPES.get(line[1], "")) for line in lines if line[0] == "property"]
    floats = [name for name, kind in fields if name in _CHANNELS and kind.startswith("f")]
    if not floats or not all(kind for _, kind in fields):
        return 0.0
    data, count = data.partition(b"\n")[2], int(vertices[1])
    if b"format ascii" in header:
        rows = np.loadtxt(data.splitlines()[:count], ndmin=2, usecols=[[n for n, _ in fields].index(f) for f in floats])
        return float(rows.max(initial=0))
    order = ">" if b"big_endian" in header else "<"
    table = np.frombuffer(data, [(name, order + kind) for name, kind in fields], count)
    return max(float(table[name].max(initial=0)) for name in floats)
