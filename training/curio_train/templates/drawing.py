"""Templates drawn by the renderer, as the frame's camera shows the object, then sampled as a crop of a frame is."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.camera import square_matrix
from curio_train.meshes.meshes import Mesh
from curio_train.rendering.renderer import Renderer
from curio_train.worlds.single_object.viewpoints import AMBIENT

APPEARANCES = (((0.0, -0.7, -0.7), 1.0), ((0.7, -0.5, -0.5), 1.6), ((-0.7, -0.5, -0.5), 1.2))
"""Lamps, and what colours are multiplied by: descriptors are means over these and over as many backgrounds."""

_BORDER_PX = 4


class Drawn:
    """Objects under several lamps, without a background."""

    colors: list[Tensor]
    """sRGB over black under each lamp, [templates, 3, side, side]."""
    alpha: Tensor
    """Fraction of each pixel that the object covers, [templates, 1, side, side]."""

    def __init__(self, stacked: Float[Tensor, "templates channels side side"]) -> None:
        *self.colors, self.alpha = stacked.split([3] * (stacked.shape[1] // 3) + [1], dim=1)

    def over(self, number: int, backgrounds: Tensor, exposure: float = 1.0) -> Tensor:
        """Pictures under one of the lamps, in [0, 1]."""
        return (exposure * self.colors[number] + (1 - self.alpha) * backgrounds).clamp(0, 1)


class TemplateRenderer:
    """Draws an object on the optical axis of a camera whose principal point is the picture's middle."""

    def __init__(self, mesh: Mesh, depth_m: float, focal_px: float, side: int) -> None:
        """Build a renderer for one distance and one camera.

        Raises:
            RendererError: The mesh cannot be rendered.
        """
        self._renderer = Renderer([mesh], [0], side, side, ambient=AMBIENT)
        self._matrix = square_matrix(focal_px, side)
        self._position = torch.tensor([0.0, 0.0, depth_m])

    def draw(self, rotations: Float[Tensor, "templates 3 3"], num_lamps: int = 1) -> Drawn:
        """Seen with rotations cam_from_obj, under the first of :data:`APPEARANCES`."""
        colors, alpha = self._renderer.cutouts(
            rotations[:, None],
            self._position.expand(len(rotations), 1, 3),
            camera_matrix=self._matrix,
            lights=torch.tensor([lamp for lamp, _ in APPEARANCES[:num_lamps]]),
        )
        return Drawn(torch.cat([*colors, alpha], dim=1))


class CropTemplateRenderer:
    """Draws an object as a crop of a frame shows it: no sharper than the frame is."""

    def __init__(self, mesh: Mesh, depth_m: float, frame_focal_px: float, crop_focal_px: float, side: int) -> None:
        """Choose distance, cameras and the crop's side.

        Raises:
            RendererError: The mesh cannot be rendered.
        """
        scale = min(1.0, frame_focal_px / crop_focal_px)  # frame pixels a crop pixel
        frame_side = 2 * int(np.ceil(side * scale / 2)) + 2 * _BORDER_PX
        self._renderer_of_frames = TemplateRenderer(mesh, depth_m, scale * crop_focal_px, frame_side)
        self._rows = row_sampling(frame_side, side, scale)

    def draw(self, rotations: Float[Tensor, "templates 3 3"]) -> Drawn:
        """Seen with rotations cam_from_obj, under all of :data:`APPEARANCES`."""
        drawn = self._renderer_of_frames.draw(rotations, len(APPEARANCES))
        stacked = torch.cat([*drawn.colors, drawn.alpha], dim=1)
        return Drawn(self._rows @ stacked @ self._rows.T)


def row_sampling(frame_side: int, side: int, scale: float) -> Float[Tensor, "side frame_side"]:
    """What each of a crop's rows is made of: two bilinear samples a pixel, averaged, of rows of ``scale`` pixels."""
    rows = (torch.arange(2 * side) - (2 * side - 1) / 2) * scale / 2 + (frame_side - 1) / 2
    left = rows.floor().long()
    samples = torch.eye(frame_side)
    return torch.lerp(samples[left], samples[left + 1], (rows - left)[:, None]).unflatten(0, (side, 2)).mean(dim=1)
