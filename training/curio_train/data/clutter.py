"""Dead leaves: shapes that cover each other (Lee, Mumford and Huang 2001, "Occlusion Models for Natural Images").

Flat, but their edges and sizes are distributed as in photographs, which smooth noise is not: what stands in front of
them has to be told from strong edges next to it, as on a real desk with print, tiles and tools.
"""

import cv2
import numpy as np
from jaxtyping import Float

_MOST_SHAPES = 160
_SMALLEST_PX, _LARGEST_FRACTION = 7.0, 0.5
_SIZE_EXPONENT = 1.1  # the number of leaves above a size falls with its power
_FRACTIONS = {"plain": 0.5, "stripes": 0.15, "tiles": 0.15, "print": 0.2}
_LETTERS = "ABCDEFGHJKLMNPRSTUVWXYZabdefghkmnpqrstuy0123456789=#&%"


def dead_leaves_texture(image: Float[np.ndarray, "height width 3"], random: np.random.Generator) -> None:
    """Cover a picture with leaves, in place: with some twenty to a hundred and more, the largest below.

    Args:
        image: float32 in [0, 1].
        random: Decides everything.
    """
    sizes = _SMALLEST_PX * random.random(int(random.integers(20, _MOST_SHAPES))) ** (-1 / _SIZE_EXPONENT)
    for size in np.sort(sizes.clip(max=_LARGEST_FRACTION * image.shape[1]))[::-1]:
        _put(image, size, random)


def _put(image: np.ndarray, size: float, random: np.random.Generator) -> None:
    height, width = image.shape[:2]
    center = random.uniform((0, 0), (width, height))
    outline = np.round(center + size * _outline(random)).astype(np.int32)
    left, top = np.clip(outline.min(axis=0), 0, (width - 1, height - 1))
    right, bottom = np.clip(outline.max(axis=0) + 1, 1, (width, height))
    if right - left < 2 or bottom - top < 2:
        return
    mask = np.zeros((bottom - top, right - left), np.uint8)
    cv2.fillPoly(mask, [outline - (left, top)], 1)
    shade = _pattern(mask.shape, size, random)[..., None]
    one, other = _color(random), _color(random)
    part = image[top:bottom, left:right]
    part[mask > 0] = (other + (one - other) * shade)[mask > 0]


def _outline(random: np.random.Generator) -> np.ndarray:
    """Corners around the origin, [corners, 2], about 1 wide: an oblique rectangle, an ellipse or any polygon."""
    kind = random.random()
    if kind < 0.55:
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], float)
    else:
        count = 24 if kind < 0.8 else int(random.integers(3, 7))
        angles = np.sort(random.uniform(0, 2 * np.pi, count)) if count < 24 else np.arange(24) * np.pi / 12
        corners = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    angle, lean = random.uniform(0, 2 * np.pi), random.uniform(-0.3, 0.3)
    squeeze = np.diag([0.5, 0.5 * random.uniform(0.12, 1.0)])
    rotation = np.array([(np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle))])
    return np.asarray(corners @ squeeze @ np.array([(1, lean), (0, 1)]) @ rotation)


def _color(random: np.random.Generator) -> np.ndarray:
    """Mostly grey, dark and light; some of any colour."""
    if random.random() < 0.35:
        return random.random(3).astype(np.float32)
    return np.clip(random.beta(0.7, 0.7) + 0.06 * random.normal(size=3), 0, 1).astype(np.float32)


def _pattern(shape: tuple[int, ...], size: float, random: np.random.Generator) -> np.ndarray:
    """Fraction of a leaf's first colour in each pixel, float32 [height, width]."""
    kind = random.choice(list(_FRACTIONS), p=list(_FRACTIONS.values()))
    if kind == "plain" or size < 8:
        return np.ones(shape, np.float32)
    if kind == "print":
        return _print(shape, random)
    v, u = np.mgrid[: shape[0], : shape[1]]
    angle = random.uniform(0, np.pi)
    pitch = random.uniform(3, max(4, size / 2))
    waves = [np.sin((u * np.cos(a) + v * np.sin(a)) * 2 * np.pi / pitch) for a in (angle, angle + np.pi / 2)]
    field = waves[0] * waves[1] if kind == "tiles" else waves[0]
    return (field > 0).astype(np.float32)


def _print(shape: tuple[int, ...], random: np.random.Generator) -> np.ndarray:
    """Lines of letters."""
    canvas = np.zeros(shape, np.uint8)
    scale = float(random.uniform(0.25, 1.2))
    line_px = max(6, int(26 * scale))
    for y in range(line_px, shape[0] + line_px, line_px):
        text = "".join(random.choice(list(_LETTERS), 24))
        cv2.putText(canvas, text, (int(-random.integers(20)), y), cv2.FONT_HERSHEY_SIMPLEX, scale, 1, 1 + (scale > 0.7))
    return canvas.astype(np.float32)
