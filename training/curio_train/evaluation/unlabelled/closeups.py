"""Contours of what was found, and the part of a photograph where it was found, for people to look at."""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

CLOSEUP_PX = 160
_MARGIN = 0.25  # of the silhouette's longer side, to every side
_INK, _RIM = (255, 196, 0), (16, 16, 16)


def outlined(
    photographs: Float[Tensor, "num 3 height width"], masks: Bool[Tensor, "num height width"]
) -> Float[Tensor, "num 3 height width"]:
    """Photographs with the contours of silhouettes drawn in; the inside stays visible."""
    drawn = []
    for photograph, mask in zip(photographs, masks, strict=True):
        canvas = np.ascontiguousarray((photograph.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8))
        contours, _ = cv2.findContours(mask.numpy().astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        width = max(1, round(min(canvas.shape[:2]) / 240))
        cv2.drawContours(canvas, contours, -1, _RIM, width + 2, cv2.LINE_AA)
        cv2.drawContours(canvas, contours, -1, _INK, width, cv2.LINE_AA)
        drawn.append(torch.from_numpy(canvas).permute(2, 0, 1).float() / 255)
    return torch.stack(drawn)


def closeups(
    images: Float[Tensor, "num 3 height width"], masks: Bool[Tensor, "num height width"]
) -> Float[Tensor, "num 3 side side"]:
    """The square around each silhouette, in equal size; the whole image where nothing was found."""
    found = []
    for image, mask in zip(images, masks, strict=True):
        left, top, side = _square(mask)
        pixels = image.permute(1, 2, 0).numpy()
        whole = cv2.copyMakeBorder(pixels, side, side, side, side, cv2.BORDER_CONSTANT, value=(0.5, 0.5, 0.5))
        cut = whole[top + side : top + 2 * side, left + side : left + 2 * side]
        resized = cv2.resize(cut, (CLOSEUP_PX, CLOSEUP_PX), interpolation=cv2.INTER_AREA)
        found.append(torch.from_numpy(resized).permute(2, 0, 1))
    return torch.stack(found)


def _square(mask: Bool[Tensor, "height width"]) -> tuple[int, int, int]:
    """Left, top and side, in pixels; it may reach beyond the image."""
    height, width = mask.shape
    if not mask.any():
        side = max(height, width)
        return (width - side) // 2, (height - side) // 2, side
    rows, columns = np.flatnonzero(mask.any(dim=1)), np.flatnonzero(mask.any(dim=0))
    longer = max(rows[-1] - rows[0], columns[-1] - columns[0]) + 1
    side = int(np.ceil(longer * (1 + 2 * _MARGIN)))
    return int((columns[0] + columns[-1] + 1 - side) // 2), int((rows[0] + rows[-1] + 1 - side) // 2), side
