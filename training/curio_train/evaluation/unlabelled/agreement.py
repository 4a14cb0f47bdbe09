"""Agreement of photographs with what was found in them, inside the silhouette and around it.

Numbers of a photograph, each in [0, 1]; all images are compared behind a 9x9 Gaussian filter and after one gain a
channel (exposure and white balance are not known):

* **inside**: the fraction of the silhouette's pixels that differ by less than 0.15 in every channel;
* **overlap**, with a background image: intersection over union of the silhouette and what differs from the background
image and is no shadow;
* **explained**, without one: of the difference, in and around the silhouette, between the photograph and what it shows
  around it, the fraction that the part as drawn takes away. So a drawing in the colours of what is around it says
  nothing.

Measured on 250 path-traced photographs of a bracket (256x192, its background image, a camera file two pixels off) with
a model that had 36 % of ADD below 0.1 diameters once the camera's error was taken out. AUROC against that, and of right
poses
against rotations off by more than 30 degrees: overlap 0.66 and 0.92; explained 0.66 and 0.85; inside 0.66 and 0.82; one
minus DSSIM in the silhouette 0.56 and 0.72; the model's own confidence 0.64 and 0.90. So a pose that is wrong is told
from one that is nearly right, and a tenth of a diameter from a fifth is not: a shift of two pixels is hardly seen.
Untrained, the same network has an overlap of 0.02, and yet 0.73 inside: a gain makes greys alike.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from curio_train.data.background_difference import compare
from curio_train.metrics.images import blurred
from curio_train.refinement.inpainting import inpainted
from curio_train.scene_code import SceneCode
from curio_train.worlds.base import World

_TOLERANCE = 0.15  # sRGB; of 0.06, 0.1 and 0.15 the one that told right from wrong best
_AROUND = 12 / 256  # of the frame's width: how far around the silhouette; 6 / 256 told less
_SCALE = 0.2  # sRGB difference that counts half; 0.1 told less
_GAINS = (0.5, 2.0)
_DARKEST = 0.02  # of a rendering's pixels that a gain is read from


@dataclass(frozen=True, eq=False)
class Drawing:
    """Scenes drawn so that they can be laid over anything."""

    over_black: Tensor
    """[num, 3, height, width], sRGB in [0, 1]."""
    through: Tensor
    """Fraction of what is behind that is seen, [num, 3, height, width]."""

    @property
    def silhouette(self) -> Bool[Tensor, "num height width"]:
        """Pixels that are at least half covered. Shadows on a plane leave more than half of it."""
        return self.through.mean(dim=1) < 0.5

    def over(self, backgrounds: Tensor) -> Float[Tensor, "num 3 height width"]:
        """Composited, sRGB in [0, 1]."""
        return (self.over_black + self.through * backgrounds).clamp(0, 1)


def draw(world: World, code: SceneCode) -> Drawing:
    """Scenes as the world's camera sees them."""
    (count, *_), camera = next(iter(code.values())).shape, world.camera
    black = torch.zeros(count, 3, camera.height, camera.width)
    over_black, over_white = (world.render(code, behind) for behind in (black, black + 1))
    return Drawing(over_black, (over_white - over_black).clamp(0, 1))


def inside(photographs: Tensor, drawing: Drawing, backgrounds: Tensor) -> Float[Tensor, " num"]:
    """Fraction of the silhouette that looks as drawn; 0 where there is none.

    Args:
        photographs: [num, 3, height, width], sRGB in [0, 1].
        drawing: What was found in them.
        backgrounds: What is thought to be behind: the background image, or the photographs themselves.
    """
    seen, drawn, mask = blurred(photographs), blurred(drawing.over(backgrounds)), drawing.silhouette
    near = (_gains(seen, drawn, mask) * drawn - seen).abs().amax(dim=1) < _TOLERANCE
    return (near & mask).sum((1, 2)).double() / mask.sum((1, 2)).clamp(min=1)


def inlier_ratio(photographs: Tensor, drawing: Drawing) -> Float[Tensor, " num"]:
    """Fraction of what the surroundings, continued, do not explain of photographs and the drawing does; 0 at worst.

    Where nothing is drawn it is 0, too.

    Differences are robust (Geman and McClure 1987), as in :mod:`~curio_train.refinement.render_and_compare`.

    Args:
        photographs: [num, 3, height, width], sRGB in [0, 1].
        drawing: What was found in them.
    """
    mask, reach = drawing.silhouette, max(1, round(_AROUND * photographs.shape[-1]))
    around = F.max_pool2d(mask[:, None].float(), 2 * reach + 1, 1, reach) > 0
    behind, seen = inpainted(photographs, around), blurred(photographs)
    gains = _gains(seen, blurred(drawing.over(photographs)), mask)
    drawn = gains * blurred(drawing.over_black) + blurred(drawing.through * behind)
    left, without = (_residual(image, seen, around[:, 0]) for image in (drawn, blurred(behind)))
    return (1 - left / without.clamp(min=1)).clamp(0, 1).double() * mask.any(dim=2).any(dim=1)


def _residual(images: Tensor, photographs: Tensor, where: Tensor) -> Float[Tensor, " num"]:
    squared = ((images - photographs) / _SCALE).square().sum(dim=1)
    return (squared / (squared + 1) * where).sum((1, 2))


def _gains(seen: Tensor, drawn: Tensor, masks: Tensor) -> Float[Tensor, "num 3 1 1"]:
    """Median ratio of each channel inside each mask; 1 in an empty one."""
    ratios = seen / drawn.clamp(min=_DARKEST)
    medians = [
        ratio[:, mask].median(dim=1).values if mask.any() else torch.ones(3)
        for ratio, mask in zip(ratios, masks, strict=True)
    ]
    return torch.stack(medians)[..., None, None].clamp(*_GAINS)


def overlap(silhouette: Tensor, differing: Tensor) -> Float[Tensor, " num"]:
    """Intersection over union of masks [num, height, width]; 1 where both are empty, which is agreement, too."""
    common, either = (mask.sum((1, 2)).double() for mask in (silhouette & differing, silhouette | differing))
    return torch.where(either > 0, common / either.clamp(min=1), 1.0)


def differing(photographs: Tensor, background_image: Tensor) -> Bool[Tensor, "num height width"]:
    """Masks of pixels where photographs clearly differ from the empty scene, without shadows and speckles.

    Args:
        photographs: [num, 3, height, width], sRGB in [0, 1].
        background_image: [3, height, width], likewise.
    """
    found = compare(photographs, background_image)
    masks = (found.differs & ~found.shaded).numpy().astype(np.uint8)
    opened = [cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) for mask in masks]
    return torch.from_numpy(np.stack(opened)).bool()
