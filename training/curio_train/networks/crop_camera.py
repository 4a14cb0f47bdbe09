"""Virtual crop cameras in torch: perspective-correct crops of a frame, inside an exported graph as well.

K is in pixels with pixel centres at integer coordinates; the camera frame is OpenCV's: x right, y down, z forward, in
metres.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from curio_train.geometry import rotation_between

_ROWS_AT_ONCE = 10


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


def about_axis(angle: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotations about the optical axis, which turn pictures clockwise, from the cosines and sines of their angles."""
    cosine, sine = angle.unbind(-1)
    zero, one = torch.zeros_like(cosine), torch.ones_like(cosine)
    return torch.stack([cosine, -sine, zero, sine, cosine, zero, zero, zero, one], dim=-1).unflatten(-1, (3, 3))


class CropCamera(NamedTuple):
    """A virtual camera at the frame camera's position that looks at one point."""

    rotation: Tensor
    """crop_from_cam, [batch, 3, 3]; its transpose turns a pose back into the frame's camera."""
    matrix: Tensor
    """K of the crop, [batch, 3, 3]; the principal point is the crop's centre."""


def crop_camera_at(direction: Float[Tensor, "batch 3"], focal_px: Float[Tensor, " batch"], size: int) -> CropCamera:
    """The camera that looks along ``direction`` with the smallest turn from the frame's optical axis.

    Args:
        direction: Towards the crop's centre, camera frame, any length, in front (z > 0).
        focal_px: Of the crop. An object of diameter d at distance z then covers focal_px * d / z pixels.
        size: Width and height of the crop, pixels.
    """
    axis = direction.new_tensor([0.0, 0.0, 1.0]).expand_as(direction)
    rotation = rotation_between(direction, axis)
    zero, one = torch.zeros_like(focal_px), torch.ones_like(focal_px)
    centre = torch.full_like(focal_px, (size - 1) / 2)
    rows = [focal_px, zero, centre, zero, focal_px, centre, zero, zero, one]
    return CropCamera(rotation, torch.stack(rows, dim=-1).unflatten(-1, (3, 3)))


def sampling_grid(
    crop: CropCamera, matrix: Float[Tensor, "batch 3 3"], size: int, frame_width: int, frame_height: int
) -> Float[Tensor, "batch {size} {size} 2"]:
    """The grid with which ``grid_sample(frame, grid, align_corners=False)`` makes the crop.

    No place is outside the frame: ``padding_mode="border"`` would do that, too, but takes onnxruntime twice as long.
    ``align_corners=False`` puts -1 and 1 at the image's borders, which lie half a pixel outside the pixel centres.
    """
    pixels = _pixel_centres(matrix, size, size).T
    # K Rᵀ K_crop⁻¹ takes crop pixels to frame pixels, and ``border`` takes those to the grid. The matrices are
    # multiplied first: with few pixels' arithmetic left, an exported graph is fast.
    border = matrix.new_tensor(
        [[2 / frame_width, 0, 1 / frame_width - 1], [0, 2 / frame_height, 1 / frame_height - 1], [0, 0, 1]]
    )
    x, y, depth = (border @ matrix @ crop.rotation.transpose(1, 2) @ inverse(crop.matrix) @ pixels).unbind(1)
    # Behind the frame's camera there is nothing to see: such pixels are sent to the border instead of mirrored.
    scale = 1 / depth.clamp(min=1e-6)
    right, bottom = 1 - 1 / frame_width, 1 - 1 / frame_height  # the centres of the last pixels
    places = torch.stack([(x * scale).clamp(-right, right), (y * scale).clamp(-bottom, bottom)], dim=-1)
    return places.unflatten(1, (size, size))


def cut_crops(
    images: Float[Tensor, "images 3 height width"],
    matrix: Float[Tensor, "3 3"],
    position_m: Float[Tensor, "images num 3"],
    focal_px: Float[Tensor, "images*num"],
    side: int,
    oversampling: int = 2,
    roll: Float[Tensor, "images*num 3 3"] | None = None,
) -> tuple[Float[Tensor, "images*num 3 {side} {side}"], Float[Tensor, "images*num 3 3"]]:
    """Crops by virtual cameras that look at positions.

    Args:
        images: Of one camera.
        matrix: Its K.
        position_m: Of the crops' middles, camera frame.
        focal_px: Of the crops, pixels; those of one image after the other.
        side: Of the crops, pixels.
        oversampling: Samples a pixel, across and down; with two, near objects do not alias.
        roll: What each camera turns what it sees by, see :func:`about_axis`; None: by nothing.

    Returns:
        The crops, and crop_from_cam.
    """
    num, fine_side = position_m.shape[1], oversampling * side
    matrices = matrix.expand(focal_px.shape[0], 3, 3)
    camera = crop_camera_at(position_m.flatten(0, 1), oversampling * focal_px, fine_side)
    if roll is not None:
        camera = camera._replace(rotation=roll @ camera.rotation)
    grid = sampling_grid(camera, matrices, fine_side, images.shape[3], images.shape[2])
    # The same few rows of all crops in one grid: no image is copied, an exported graph may cut any number of crops, and
    # what the grid's places need stays in a core's cache.
    strips = [
        F.grid_sample(images, rows.flatten(1, 2), align_corners=False).unflatten(2, (num, -1))
        for rows in grid.unflatten(0, (-1, num)).split(_ROWS_AT_ONCE, dim=2)
    ]
    crops = torch.cat(strips, dim=3).transpose(1, 2).flatten(0, 1)
    return (F.avg_pool2d(crops, oversampling) if oversampling > 1 else crops), camera.rotation
