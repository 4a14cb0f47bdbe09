"""Whole frame to pose by templates alone, in one graph: nothing in it was trained but the frozen trunk."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from curio_train.networks.outline_alignment import OutlineAlignment
from curio_train.networks.templates.geometry import FRAME_STRIDE, Geometry, num_views
from curio_train.networks.templates.localiser import Localiser
from curio_train.networks.templates.reader import CalibrationFeatures, Places, PoseReader
from curio_train.networks.templates.trunk import Trunk
from curio_train.scene_code import COLOR, TRANSLATION


class TemplateNetwork(nn.Module):
    """Localise, match, align."""

    trunk: Trunk
    """The frozen feature extractor."""
    localiser: Localiser
    """Finds centre proposals in the frame."""
    reader: PoseReader
    """Finds the pose at the centre proposals."""
    outline: OutlineAlignment | None
    """Aligns poses with outlines in the end; None: they stay as the reader answers them."""
    geometry: Geometry
    """Geometry of frames and object."""

    color: Tensor
    """Base colour of an object whose mesh has no colours, in templates and answers, sRGB [3]; else empty."""

    _matrix: Tensor

    def __init__(
        self,
        geometry: Geometry,
        *,
        has_color: bool = False,
        aligns_outlines: bool = False,
    ) -> None:
        """Build for frames and an object; all templates are still empty.

        Args:
            geometry: Of frames and object.
            has_color: Whether codes have a colour.
            aligns_outlines: Whether poses are aligned with the object's outline in the end.
        """
        super().__init__()
        self.trunk, self.localiser, self.reader = Trunk(), Localiser(geometry), PoseReader([geometry])
        self.outline = OutlineAlignment(num_views(geometry.any_side)) if aligns_outlines else None
        self.geometry = geometry
        self.register_buffer("_matrix", torch.from_numpy(geometry.matrix).float(), persistent=False)
        self.register_buffer("color", torch.zeros(3 if has_color else 0), persistent=has_color)
        self.requires_grad_(False)
        self.eval()

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> dict[str, Tensor]:
        """Codes in the frame's camera: metres, 6D rotation and confidence [batch, 1, …], light [batch, 3]."""
        code: dict[str, Tensor] = self.reader(self.trunk, images, self._places(images))
        return self._finished(images, code)

    def read(self, images: Float[Tensor, "batch 3 height width"]) -> tuple[dict[str, Tensor], CalibrationFeatures]:
        """The code without its confidence, and what that is made of."""
        code, features = self.reader.read(self.trunk, images, self._places(images))
        return self._finished(images, code), features

    def _finished(self, images: Tensor, code: dict[str, Tensor]) -> dict[str, Tensor]:
        """The code with its pose aligned, and with the colour, where the network has them."""
        if self.outline is not None:
            code, _ = self.outline.of_code(images, self._matrix, code, self.geometry.diameter_m)
        if not len(self.color):
            return code
        return code | {COLOR: self.color.expand(*code[TRANSLATION].shape[:2], 3)}

    def _places(self, images: Tensor) -> Places:
        position_m, score = self.localiser(self.trunk(F.avg_pool2d(images, FRAME_STRIDE))[1])
        return Places(position_m[:, None], score[:, None], torch.zeros(1, dtype=torch.long, device=images.device))
