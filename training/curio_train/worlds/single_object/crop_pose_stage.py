"""The crop-pose stage: crops of 64 pixels around the object; codes have pose, light and confidence.

Constants fixed before any training:

* at the depth that the localisation stage estimates, the object's diameter spans 0.6 of the crop's side;
* that estimate may be off by a quarter of the diameter to each side, and by a quarter (as e^±0.25) in distance;
* one crop of seven shows no object.
"""

from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.color import linear_from_srgb, srgb_from_linear
from curio_train.config import NetworkConfig
from curio_train.data.backgrounds import Backgrounds
from curio_train.networks.two_stage.crop_pose import OBJECT_COORDINATES, OBJECT_COORDINATES_STRIDE, CropPoseNetwork
from curio_train.rendering.object_coordinates import ObjectCoordinateMap
from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, TRANSLATION, Field, SceneCode
from curio_train.worlds.base import Camera
from curio_train.worlds.single_object.crop_pose_loss import ASSUMED_DEPTH, CropPoseLoss, position_in_metres
from curio_train.worlds.single_object.localisation_stage import camera_grid
from curio_train.worlds.single_object.viewpoints import allocentric_to_egocentric
from curio_train.worlds.single_object.world import EXPOSURE, Object, SingleObjectWorld, pose_code, pose_layout

CROP_PX, FILL = 64, 0.6
MAX_OFFSET, MAX_LOG_SCALE = 0.25, 0.25
"""Errors of the localisation stage, in diameters and in logarithms of the depth."""
ABSENT_FRACTION = 1 / 7

_LEAST_SEEN_THROUGH = 0.01  # of a pixel that is not inside the object
_LEAST_LIGHT = 1e-3
_DARKEST = 0.01  # linear
_POSITION_MARGIN = 1.5  # of the position field's range over these errors


class CropPoseStage(SingleObjectWorld):
    """Crops around the object; the code is in the crop camera's frame.

    The position is (x, y) in diameters and z in assumed depths, so all crops have the same K: focal length
    FILL · CROP_PX, centre in the middle. The crop camera in pixels and metres has the focal length
    FILL · CROP_PX · assumed depth / diameter.
    """

    random_appearance = True
    given = (ASSUMED_DEPTH,)

    def __init__(self, object_: Object) -> None:
        camera = Camera(CROP_PX, CROP_PX, crop_matrices(np.array([FILL * CROP_PX]), CROP_PX)[0])
        offset, scale = _POSITION_MARGIN * MAX_OFFSET, float(np.exp(_POSITION_MARGIN * MAX_LOG_SCALE))
        position = Field(
            TRANSLATION,
            3,
            unit="1",
            frame="crop",
            activation="perspective",
            lower=(-offset, -offset, 1 / scale),
            upper=(offset, offset, scale),
        )
        super().__init__("crop pose", object_, camera, pose_layout(position, confidence=True, color=object_.unpainted))
        self._loss = CropPoseLoss(object_)

    def network(self, config: NetworkConfig) -> CropPoseNetwork:
        """A new residual network whose cells predict the pose."""
        return CropPoseNetwork(self.layout, camera_grid(self.camera, self.layout[TRANSLATION]))

    def sample(self, count: int, seed: tuple[int, ...]) -> dict[str, Tensor]:
        """Objects near the middle of crops, as the errors of the localisation stage leave them."""
        random = np.random.default_rng(seed)
        offset, scale = _localisation_errors(count, random)
        assumed = torch.from_numpy(random.uniform(self.object.near_m, self.object.far_m, (count, 1))).float()
        position = torch.from_numpy(np.concatenate([offset * scale, scale], axis=1)).float()
        position_m = self._in_metres(position, assumed)
        rotation = allocentric_to_egocentric(position_m, self.object.rotations(count, random))
        code = pose_code(position, rotation, self.sample_lights(count, random)) | {ASSUMED_DEPTH: assumed}
        code |= self.sample_colors(count, random)
        code[CONFIDENCE] = torch.from_numpy(random.random((count, 1, 1)) >= ABSENT_FRACTION).float()
        return self._with_coordinates(code, rotation, position_m)

    def perturbed(self, position_m: Float[Tensor, "count 3"], random: np.random.Generator) -> Float[Tensor, "count 3"]:
        """Positions, metres in the frame's camera, as the localisation stage may estimate these true ones."""
        offset, scale = _localisation_errors(len(position_m), random)
        offset_m = offset * self.object.kind.diameter_m
        shift = np.concatenate([offset_m * scale, np.zeros_like(scale)], axis=1)
        return (position_m - torch.from_numpy(shift).to(position_m)) / torch.from_numpy(scale).to(position_m)

    def label_crops(
        self,
        code: SceneCode,
        position_m: Float[Tensor, "count 3"],
        rotation: Float[Tensor, "count 3 3"],
        assumed_depth_m: Float[Tensor, "count 1"],
    ) -> dict[str, Tensor]:
        """The codes of crops that show the object.

        Args:
            code: The object's colour, if the code of this stage has one, and the light, in the crop cameras' frames.
            position_m: In the crop cameras' frames.
            rotation: crop_from_obj.
            assumed_depth_m: Of the crop cameras.
        """
        diameter_m = self.object.kind.diameter_m
        position = torch.cat([position_m[:, :2] / diameter_m, position_m[:, 2:] / assumed_depth_m], dim=1)
        labels = pose_code(position, rotation, code[LIGHT]) | {ASSUMED_DEPTH: assumed_depth_m}
        labels |= {name: code[name] for name in (COLOR,) if name in self.layout}
        labels[CONFIDENCE] = torch.ones(len(position), 1, 1)
        return self._with_coordinates(labels, rotation, position_m)

    def backgrounds(self, cache: Path) -> Backgrounds:
        """The object's backgrounds, in the parts that crops show."""
        focal_per_width = self.object.camera.matrix[0, 0] / self.object.camera.width
        side_m = self.object.kind.diameter_m / FILL
        largest, smallest = (focal_per_width * side_m / z for z in (self.object.near_m, self.object.far_m))
        return self.object.backgrounds(cache).of_crops(smallest, largest)

    def render(self, code: SceneCode, backgrounds: Tensor | None = None) -> Tensor:
        """The object in each crop camera; the code must have ``assumed_depth_m``."""
        position_m = self._in_metres(code[TRANSLATION][:, 0].float(), code[ASSUMED_DEPTH].float())
        return self._render(code, position_m[:, None], self._matrices(code, CROP_PX), backgrounds)

    @torch.no_grad()
    def _exposure(self, code: SceneCode, images: Tensor) -> Float[Tensor, "batch 1 3"]:
        """Exposure that makes the object, channel by channel, as bright as the crops are inside it."""
        black = torch.zeros_like(images)
        over_black, over_white = (self.render(code, background) for background in (black, black + 1))
        inside = (over_white - over_black).mean(1, keepdim=True) < _LEAST_SEEN_THROUGH
        seen, rendered = ((linear_from_srgb(image.clamp(0, 1)) * inside).sum((2, 3)) for image in (images, over_black))
        return srgb_from_linear((seen / rendered.clamp(min=_LEAST_LIGHT)).clamp(min=_DARKEST))[:, None]

    def comparable(self, code: SceneCode, images: Tensor) -> SceneCode:
        """The code, opaque and with the exposure of the crops.

        Exposures are no part of codes, and without one the image loss would mend brightness by wrong poses. The
        confidence says whether a pose is right, which is no transparency.
        """
        opaque = {name: value for name, value in code.items() if name != CONFIDENCE}
        return opaque | {EXPOSURE: self._exposure(opaque, images)}

    def code_loss(self, predicted: SceneCode, true: SceneCode) -> Float[Tensor, ""]:
        """See :class:`~curio_train.worlds.single_object.crop_pose_loss.CropPoseLoss`."""
        return self._loss(predicted, true)

    def _with_coordinates(self, code: dict[str, Tensor], rotation: Tensor, position_m: Tensor) -> dict[str, Tensor]:
        side = CROP_PX // OBJECT_COORDINATES_STRIDE
        points, visible = self._object_coordinates(rotation, position_m, self._matrices(code, side))
        return code | {OBJECT_COORDINATES: torch.cat([points, visible[:, None]], dim=1)}

    def _matrices(self, code: SceneCode, side: int) -> np.ndarray:
        """K [batch, 3, 3] of each crop camera at ``side`` pixels."""
        return crop_matrices(FILL * side * code[ASSUMED_DEPTH][:, 0].cpu().numpy() / self.object.kind.diameter_m, side)

    def _in_metres(self, position: Tensor, assumed_depth_m: Tensor) -> Tensor:
        return position_in_metres(position, assumed_depth_m, self.object.kind.diameter_m)

    @cached_property
    def _object_coordinates(self) -> ObjectCoordinateMap:
        return ObjectCoordinateMap(self.object.mesh, CROP_PX // OBJECT_COORDINATES_STRIDE)


def _localisation_errors(count: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Offsets [count, 2] in diameters and factors on the depth [count, 1]."""
    offset = random.uniform(-MAX_OFFSET, MAX_OFFSET, (count, 2))
    return offset, np.exp(random.uniform(-MAX_LOG_SCALE, MAX_LOG_SCALE, (count, 1)))


def crop_matrices(focal_px: Float[np.ndarray, " count"], side: int) -> Float[np.ndarray, "count 3 3"]:
    """K of square crops of ``side`` pixels with the principal point in the middle."""
    matrices = np.zeros((len(focal_px), 3, 3))
    matrices[:, 0, 0] = matrices[:, 1, 1] = focal_px
    matrices[:, [0, 1], 2] = (side - 1) / 2
    matrices[:, 2, 2] = 1
    return matrices
