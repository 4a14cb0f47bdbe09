"""Pinhole cameras: reading and refusing intrinsics, projecting, rescaling, and the perspective crops of the gaze.

K is in pixels with pixel centres at integer coordinates (OpenCV's and BOP's habit): the image reaches from -0.5 to
width - 0.5. The camera frame is OpenCV's: x right, y down, z forward, metres.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.errors import CameraError
from curio_train.geometry import rotation_between

# Between a 1.1 degree telephoto and a 169 degree field of view; outside, K is in other units or of another image.
_FOCAL_PER_WIDTH = (0.05, 50.0)
_MATRIX_FORM = "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels"


@dataclass(frozen=True)
class Intrinsics:
    """A real camera, as its file describes it.

    Attributes:
        matrix: K, [3, 3] float64, pixels.
        width: Of the stored image, pixels.
        height: Of the stored image, pixels.
        distortion: OpenCV's (k1, k2, p1, p2, k3), or empty for none.
    """

    matrix: np.ndarray
    width: int
    height: int
    distortion: tuple[float, ...] = ()


def check_matrix(matrix: object, width: int, height: int, where: str = "camera matrix") -> np.ndarray:
    """K as a float64 array [3, 3], or a refusal.

    Args:
        matrix: What claims to be K: rows of numbers, or an array.
        width: Of the image K belongs to, pixels.
        height: Of the image K belongs to, pixels.
        where: File and field, for the message.

    Raises:
        CameraError: It is not the K of a pinhole camera, or not of an image of this size.
    """
    try:
        found = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError) as exc:
        raise CameraError(f"{where}: found {matrix!r}, expected 3x3 numbers {_MATRIX_FORM}") from exc
    if found.shape != (3, 3):
        raise CameraError(f"{where}: found an array of shape {found.shape}, expected 3x3 {_MATRIX_FORM}")
    problem = _what_is_wrong(found, width, height)
    if problem:
        raise CameraError(f"{where}: {problem}; found {found.tolist()}, expected {_MATRIX_FORM} for {width}x{height}")
    return found


def _what_is_wrong(matrix: np.ndarray, width: int, height: int) -> str:
    """Why this cannot be the K of an image of that size, or nothing."""
    if not np.isfinite(matrix).all():
        return "it has entries that are not finite numbers"
    if not np.array_equal(matrix[2], [0, 0, 1]):
        transposed = np.array_equal(matrix[:, 2], [0, 0, 1])
        return "it is transposed (row order expected)" if transposed else "its bottom row is not 0, 0, 1"
    fx, fy = matrix[0, 0], matrix[1, 1]
    if fx == 0 or fy == 0:
        return "it is singular: a focal length is 0"
    if fx < 0 or fy < 0:
        return f"negative focal length (fx {fx:g}, fy {fy:g}): a mirrored image cannot be described by K"
    if matrix[1, 0] != 0 or abs(matrix[0, 1]) > 0.1 * fx:
        return "the entries beside the focal lengths must be 0 (a small skew at row 0, column 1 is allowed)"
    return _what_does_not_fit(matrix, width, height)


def _what_does_not_fit(matrix: np.ndarray, width: int, height: int) -> str:
    low, high = _FOCAL_PER_WIDTH
    focal, (cx, cy) = min(matrix[0, 0] / width, matrix[1, 1] / height), matrix[:2, 2]
    if not low <= focal <= high:
        return f"a focal length of {focal:.3g} image sizes is no camera's: K must be in pixels of the stored image"
    if not (-0.5 <= cx <= width - 0.5 and -0.5 <= cy <= height - 0.5):
        return (
            f"the principal point ({cx:g}, {cy:g}) lies outside the {width}x{height} image: K belongs to another "
            f"size, scale it as the image was scaled"
        )
    return ""


def load_intrinsics(path: Path) -> Intrinsics:
    """Camera JSON (``camera_matrix``, ``width``, ``height``, ``distortion``) or BOP's ``camera.json``.

    Raises:
        CameraError: The file is missing, not JSON, or describes no camera.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as exc:
        raise CameraError(f"{path}: cannot be read ({exc.strerror}); expected camera JSON") from exc
    except ValueError as exc:
        raise CameraError(f"{path}: not JSON ({exc})") from exc
    if not isinstance(content, dict):
        raise CameraError(f"{path}: found a {type(content).__name__}, expected an object with camera_matrix or fx")
    width, height = (_size(content, key, path) for key in ("width", "height"))
    if "camera_matrix" in content:
        return _from_curio(content, width, height, path)
    if {"fx", "fy", "cx", "cy"} <= content.keys():
        matrix = [[content["fx"], 0, content["cx"]], [0, content["fy"], content["cy"]], [0, 0, 1]]
        return Intrinsics(check_matrix(matrix, width, height, f"{path}, fx fy cx cy"), width, height)
    raise CameraError(f"{path}: found the keys {sorted(content)}, expected camera_matrix, or BOP's fx, fy, cx and cy")


def _from_curio(content: Mapping[str, object], width: int, height: int, path: Path) -> Intrinsics:
    matrix = check_matrix(content["camera_matrix"], width, height, f"{path}, camera_matrix")
    distortion = content.get("distortion", [])
    numbers = isinstance(distortion, list) and all(isinstance(v, int | float) and np.isfinite(v) for v in distortion)
    if not isinstance(distortion, list) or not numbers or len(distortion) not in (0, 5):
        raise CameraError(f"{path}, distortion: found {distortion!r}, expected 5 numbers [k1, k2, p1, p2, k3] or none")
    return Intrinsics(matrix, width, height, tuple(float(v) for v in distortion))


def _size(content: Mapping[str, object], key: str, path: Path) -> int:
    value = content.get(key)
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise CameraError(f"{path}, {key}: found {value!r}, expected a whole number of pixels")
    return value


def scale_matrix(matrix: np.ndarray, from_size: tuple[int, int], to_size: tuple[int, int]) -> np.ndarray:
    """K after resizing the image; sizes are (width, height).

    With pixel centres at integers u' = (u + 0.5) s - 0.5, so the principal point moves by (s - 1) / 2 beside scaling.
    """
    sx, sy = (to / of for to, of in zip(to_size, from_size, strict=True))
    resize = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]])
    return resize @ np.asarray(matrix, dtype=np.float64)


def project(points: Float[Tensor, "*#batch n 3"], matrix: Float[Tensor, "*#batch 3 3"]) -> Float[Tensor, "... n 2"]:
    """Pixels of points in the camera frame (metres). Points must lie in front: z > 0."""
    homogeneous = points @ matrix.transpose(-1, -2)
    return homogeneous[..., :2] / homogeneous[..., 2:]


def rays(matrix: Float[Tensor, "*batch 3 3"], width: int, height: int) -> Float[Tensor, "*batch {height} {width} 3"]:
    """The point at depth z = 1 that each pixel's centre sees, camera frame."""
    pixels = _pixel_centres(matrix, width, height)
    return (pixels @ inverse(matrix).transpose(-1, -2)).unflatten(-2, (height, width))


def inverse(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """K⁻¹, written out: exact for K's triangle, and without a solver in an exported graph."""
    fx, skew, cx = matrix[..., 0, :].unbind(-1)
    _, fy, cy = matrix[..., 1, :].unbind(-1)
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    rows = [1 / fx, -skew / (fx * fy), (skew * cy / fy - cx) / fx, zero, 1 / fy, -cy / fy, zero, zero, one]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def _pixel_centres(like: Tensor, width: int, height: int) -> Tensor:
    """Homogeneous pixel coordinates [height * width, 3] row after row."""
    v, u = torch.meshgrid(
        torch.arange(height, dtype=like.dtype, device=like.device),
        torch.arange(width, dtype=like.dtype, device=like.device),
        indexing="ij",
    )
    return torch.stack([u, v, torch.ones_like(u)], dim=-1).flatten(0, 1)


class CropCamera(NamedTuple):
    """A virtual camera at the same place that looks at one point: a perspective-correct crop.

    Attributes:
        rotation: gaze_from_cam, [batch, 3, 3]. A pose seen by the gaze is turned back with its transpose.
        matrix: K of the crop, [batch, 3, 3]; the principal point is the crop's centre.
        homography: Crop pixels of frame pixels, K_crop R K⁻¹, [batch, 3, 3].
    """

    rotation: Tensor
    matrix: Tensor
    homography: Tensor


def crop_camera_at(
    direction: Float[Tensor, "batch 3"],
    focal_px: Float[Tensor, " batch"],
    size: int,
    matrix: Float[Tensor, "batch 3 3"],
) -> CropCamera:
    """The camera that looks along ``direction`` with the smallest turn from the frame's optical axis.

    Args:
        direction: Towards the crop's centre, camera frame, any length, in front (z > 0).
        focal_px: Of the crop. An object of diameter d at distance z then covers focal_px * d / z pixels.
        size: Width and height of the crop, pixels.
        matrix: K of the frame.
    """
    axis = direction.new_tensor([0.0, 0.0, 1.0]).expand_as(direction)
    rotation = rotation_between(direction, axis)
    zero, one = torch.zeros_like(focal_px), torch.ones_like(focal_px)
    centre = torch.full_like(focal_px, (size - 1) / 2)
    rows = [focal_px, zero, centre, zero, focal_px, centre, zero, zero, one]
    crop = torch.stack(rows, dim=-1).unflatten(-1, (3, 3))
    return CropCamera(rotation, crop, crop @ rotation @ inverse(matrix))


def sampling_grid(
    gaze: CropCamera, matrix: Float[Tensor, "batch 3 3"], size: int, frame_width: int, frame_height: int
) -> Float[Tensor, "batch {size} {size} 2"]:
    """Where ``grid_sample(frame, grid, align_corners=False)`` must look for each pixel of the crop.

    ``align_corners=False`` puts -1 and 1 at the image's borders, which lie half a pixel outside the pixel centres. The
    inverse homography K Rᵀ K_crop⁻¹ is written out: no solver then enters an exported graph.
    """
    seen = rays(gaze.matrix, size, size).flatten(1, 2)
    frame = seen @ gaze.rotation @ matrix.transpose(-1, -2)
    # Behind the frame's camera there is nothing to see: such pixels are sent far outside instead of mirrored into it.
    depth = frame[..., 2:].clamp(min=1e-6)
    border = frame.new_tensor([frame_width, frame_height])
    return ((2 * frame[..., :2] / depth + 1) / border - 1).unflatten(1, (size, size))
