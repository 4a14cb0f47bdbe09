"""The letters W, X, Y and Z as extruded outlines, standing upright and facing +z."""

from collections.abc import Mapping

import numpy as np

from curio_train.meshes.meshes import Mesh

# Outlines in the plane of the letter, height 1, y up, clockwise from the upper left corner.
_OUTLINES: Mapping[str, tuple[tuple[float, float], ...]] = {
    "W": (
        *((0, 1), (0.22, 1), (0.33, 0.42), (0.45, 0.85), (0.65, 0.85), (0.77, 0.42), (0.88, 1), (1.1, 1)),
        *((0.88, 0), (0.68, 0), (0.55, 0.5), (0.42, 0), (0.22, 0)),
    ),
    "X": (
        *((0, 1), (0.26, 1), (0.4, 0.72), (0.54, 1), (0.8, 1), (0.54, 0.5)),
        *((0.8, 0), (0.54, 0), (0.4, 0.28), (0.26, 0), (0, 0), (0.26, 0.5)),
    ),
    "Y": ((0, 1), (0.25, 1), (0.4, 0.7), (0.55, 1), (0.8, 1), (0.52, 0.45), (0.52, 0), (0.28, 0), (0.28, 0.45)),
    "Z": (
        *((0, 1), (0.8, 1), (0.8, 0.8), (0.3, 0.2), (0.8, 0.2), (0.8, 0)),
        *((0, 0), (0, 0.2), (0.5, 0.8), (0, 0.8)),
    ),
}


def letter(name: str, height_m: float, depth_m: float) -> Mesh:
    """One of W, X, Y, Z of that height and thickness; the origin is its middle.

    Raises:
        ValueError: Another letter.
    """
    if name not in _OUTLINES:
        raise ValueError(f"letter {name!r}: there are outlines of {', '.join(_OUTLINES)}")
    outline = np.array(_OUTLINES[name]) * height_m
    return extruded(outline - (outline.min(axis=0) + outline.max(axis=0)) / 2, depth_m)


def extruded(outline_m: np.ndarray, depth_m: float) -> Mesh:
    """The prism over a simple polygon [num_corners, 2], clockwise, that reaches from -depth/2 to depth/2 in z."""
    count = len(outline_m)
    here = np.arange(count)
    following = (here + 1) % count
    front = triangles(outline_m)
    sides = np.concatenate(
        [np.stack([here, following, here + count], 1), np.stack([following, following + count, here + count], 1)]
    )
    ends = [np.column_stack([outline_m, np.full(count, z)]) for z in (depth_m / 2, -depth_m / 2)]
    return Mesh(np.concatenate(ends), np.concatenate([front, front[:, ::-1] + count, sides]).astype(np.int64))


def triangles(outline: np.ndarray) -> np.ndarray:
    """A simple polygon [num_corners, 2], clockwise, as counter-clockwise triangles of its corners, by cutting off ears.

    Raises:
        ValueError: No ear is left to cut: the polygon crosses itself or is listed counter-clockwise.
    """
    remaining, found = list(range(len(outline)))[::-1], []
    while len(remaining) > 2:
        triples = zip(remaining[-1:] + remaining[:-1], remaining, remaining[1:] + remaining[:1], strict=True)
        ear = next((triple for triple in triples if _is_ear(outline, triple, remaining)), None)
        if ear is None:
            raise ValueError(f"no ear among corners {remaining}; expected a simple polygon, clockwise")
        found.append(ear)
        remaining.remove(ear[1])
    return np.array(found)


def _is_ear(outline: np.ndarray, triple: tuple[int, int, int], remaining: list[int]) -> bool:
    """Whether the corner in the middle is convex and its triangle holds no other corner."""
    a, b, c = outline[list(triple)]
    others = outline[[corner for corner in remaining if corner not in triple]]
    inside = (_cross(b - a, others - a) >= 0) & (_cross(c - b, others - b) >= 0) & (_cross(a - c, others - c) >= 0)
    return bool(_cross(b - a, c - b) > 0 and not inside.any())


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
