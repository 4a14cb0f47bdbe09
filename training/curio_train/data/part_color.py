"""What colour a part has whose CAD file says none: where photographs of it differ from the empty scene's.

No label is needed (:mod:`~curio_train.data.background_difference`). A colour is believed where photographs agree on it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from curio_train.camera import Intrinsics
from curio_train.color import linear_from_srgb, srgb_from_linear
from curio_train.data.background_difference import compare
from curio_train.data.photographs import Photographs, read_frame, read_frames, spread
from curio_train.meshes.meshes import Mesh

_WIDTH_PX = 160
_MOST_COMPARED = 64
_FEWEST = 3
_LEAST_FRACTION = 0.25  # of the photographs compared
_CLEARLY = 0.5  # of the strongest difference: a shadow beside a part is weaker
_LEAST_AREA, _LARGEST_AREA = 0.001, 0.4  # of the frame
_LEAST_UNSHADED = 0.2  # of all that differs; below it the part itself is a grey like a shadow
_WELL_LIT = 0.9  # quantile of the photographs' values: shadows darken some, nothing makes paint lighter
_LEAST_AGREEING = 0.5  # of those that show something
_LARGEST_SPREAD = 0.12  # of the photographs' tints, as fractions of the largest channel


@dataclass(frozen=True)
class FoundColor:
    """A part's colour."""

    hex: str
    """The colour as HTML writes it, sRGB, such as #8a6f4c."""
    num_used: int
    """Photographs that show it."""
    num_compared: int
    """Photographs looked at."""


def is_unpainted(mesh: Mesh) -> bool:
    """Whether the mesh file has no colours."""
    return mesh.texture is None and mesh.vertex_colors_srgb is None


def find_color(photos: Path, background_image: Path, camera: Intrinsics) -> FoundColor | None:
    """The colour of what moves over a background image, or None where the photographs do not tell it.

    What is found is the colour of its better lit half: paint of about this colour looks so in light of strength one.

    Args:
        photos: Folder; up to 64 photographs spread over it are read.
        background_image: The empty scene; it may lie among them.
        camera: That took both.

    Raises:
        DataError: One cannot be read, or is not of the camera's size.
    """
    chosen = spread(Photographs(photos, (background_image,)).paths, _MOST_COMPARED)
    height = max(1, round(_WIDTH_PX * camera.height / camera.width))
    empty = cv2.resize(read_frame(background_image, camera), (_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    frames = read_frames(chosen, camera, _WIDTH_PX, height).transpose(0, 2, 3, 1)
    seen = [color for frame in frames if (color := _color_of_piece(frame, empty)) is not None]
    if len(seen) < max(_FEWEST, _LEAST_FRACTION * len(chosen)):
        return None
    agreed = _consensus(seen)
    return None if agreed is None else FoundColor(_hex(agreed[0]), agreed[1], len(chosen))


def _consensus(colors: Sequence[np.ndarray]) -> tuple[np.ndarray, int] | None:
    """The median tint of linear colours, well lit, [3] sRGB, and how many agree on it; None where too few do."""
    srgb = srgb_from_linear(torch.from_numpy(np.stack(colors))).numpy()
    tints = srgb / srgb.max(axis=1, keepdims=True).clip(1e-3)
    tint: np.ndarray = np.median(tints, axis=0)
    num_agreeing = int((np.abs(tints - tint).max(axis=1) <= _LARGEST_SPREAD).sum())
    if num_agreeing < _LEAST_AGREEING * len(colors):
        return None
    return tint / tint.max() * np.quantile(srgb.max(axis=1), _WELL_LIT), num_agreeing


def _color_of_piece(frame: np.ndarray, background_image: np.ndarray) -> np.ndarray | None:
    """Linear colour [3] of what two uint8 sRGB pictures [height, width, 3] differ in; None if nothing, or all."""
    photograph, empty = (
        torch.from_numpy(picture).permute(2, 0, 1).float() / 255 for picture in (frame, background_image)
    )
    difference, differs, shaded = (found[0].numpy() for found in compare(photograph[None], empty))
    if not differs.any():
        return None
    differs &= difference > _CLEARLY * np.quantile(difference[differs], 0.95)
    whole, part = _largest_piece(differs), _largest_piece(differs & ~shaded)
    if part.sum() < _LEAST_UNSHADED * whole.sum():
        part = whole
    if not _LEAST_AREA < part.mean() < _LARGEST_AREA:
        return None
    pixels = linear_from_srgb(photograph[:, torch.from_numpy(part)]).T.numpy()
    bright = pixels.sum(axis=1)
    color: np.ndarray = pixels[bright >= np.median(bright)].mean(axis=0)
    return color


def _largest_piece(differs: np.ndarray) -> np.ndarray:
    """The largest connected part of a mask [height, width] without its speckles and its soft edge."""
    kernel = np.ones((3, 3), np.uint8)
    opened = cv2.morphologyEx(differs.astype(np.uint8), cv2.MORPH_OPEN, kernel)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(opened)
    if len(stats) < 2:
        return np.zeros_like(differs)
    whole = labels == 1 + np.argmax(stats[1:, cv2.CC_STAT_AREA])
    inner = cv2.erode(whole.astype(np.uint8), kernel).astype(bool)
    return inner if inner.any() else whole


def _hex(srgb: np.ndarray) -> str:
    return "#" + bytes((srgb.clip(0, 1) * 255).round().astype(np.uint8)).hex()
