"""Render and compare: poses predicted by a network, optimised until their renderings look like the frame.

A crop around each estimate is modelled as the object over a background. The background behind the object is unknown, so
it is inpainted from around the silhouette. Between a silhouette and the true outline, either the object is rendered
over background or background over the object; both give a gradient towards the true outline. The rendering's gain and
offset are fitted to the crop (least squares inside the silhouette). The residual is robust and redescending (Geman and
McClure 1987): occluders, and whatever the inpainted background gets wrong, have almost no gradient.

Adam optimises pose and light, first on blurred crops, then on sharp ones; before each round the background is inpainted
anew, closer and closer to the silhouette. A result replaces the estimate only if its residual is smaller, it is near
the estimate, and enough of the silhouette is inliers: pixels that the background alone does not explain.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from curio_train.errors import UsageError
from curio_train.geometry import rotation_angle_deg
from curio_train.meshes.meshes import Mesh
from curio_train.networks.crop_camera import cut_crops
from curio_train.refinement.crops import Crops, PoseAndLight, PoseUpdate
from curio_train.refinement.inpainting import blurred, dilated, inpainted
from curio_train.refinement.template_poses import with_mean_depth
from curio_train.rendering.renderer import Renderer
from curio_train.scene_code import COLOR, LIGHT, ROTATION_6D, TRANSLATION, SceneCode, index
from curio_train.worlds.base import Camera, World
from curio_train.worlds.single_object.crop_pose_stage import crop_matrices
from curio_train.worlds.single_object.viewpoints import AMBIENT
from curio_train.worlds.single_object.world import SingleObjectWorld

CROP_PX, FILL = 96, 0.6
"""Side of the crop, and the fraction of it that the object's diameter spans."""

MAX_ROTATION_DEG, MAX_OFFSET, MAX_LOG_DEPTH = 25.0, 0.3, 0.15
"""How far a result may be from the estimate: rotation, diameters across the view, logarithm of the depth."""

MIN_INLIER_RATIO = 0.3
"""Least fraction of the silhouette that fits, of a pose that is accepted.

Most renderings with the object have 0.5 to 0.9; nine of ten renderings of clutter alone have less than this.
"""


class _Round(NamedTuple):
    """Blur and background margin of one round."""

    times_blurred: int
    """How often crops and renderings are blurred."""
    margin_px: int
    """The background is inpainted within this margin of the silhouette at the beginning of the round. Over clutter,
    rendering an object too large costs less than too small, and poses come out too near, the more the wider the margin
    (decision 66)."""


_ROUNDS = (_Round(2, 2), _Round(1, 1), _Round(0, 1), _Round(0, 1))
_STEPS = 12  # a round
_LEARNING_RATES = {"across": 0.01, "log_depth": 0.015, "rotation_vector": 0.03, "light": 0.05}
_BETAS = (0.8, 0.95)  # of Adam: there are few steps
_MIN_GAIN, _MAX_GAIN = 0.4, 2.0
_MIN_VARIANCE = 0.002  # of colours below which gains are uncertain
DEFAULT_LIGHT = 0.0, -0.4, -0.5  # from above the camera, for poses that are not optimised
_BATCH_SIZE = 32  # of poses that are not optimised


class Refined(NamedTuple):
    """Poses after the optimisation."""

    code: dict[str, Tensor]
    """Refined positions and rotations where the result was accepted, everything else as it was."""
    accepted: Bool[Tensor, " batch"]
    """Whether it was accepted."""
    residual: Float[Tensor, " batch"]
    """Mean robust residual of the optimised poses, accepted or not, inside and around their silhouettes, 0 to 1."""
    light: Float[Tensor, "batch 3"]
    """Light that the optimised poses are rendered in; the code keeps the estimate's."""


class RenderAndCompare:
    """Refines poses of one object in frames of one camera."""

    diameter_m: float
    """Diameter of the object."""

    def __init__(self, mesh: Mesh, camera: Camera, diameter_m: float, *, from_templates: bool = False) -> None:
        """Build the renderer.

        Args:
            mesh: Of the object.
            camera: Of the frames, with K.
            diameter_m: Of the object; crops and limits are measured in it.
            from_templates: Estimates are poses of template matching, see
                :func:`~curio_train.refinement.template_poses.with_mean_depth`.
        """
        self._camera = camera
        self._matrix = torch.from_numpy(np.asarray(camera.matrix)).float()
        self.diameter_m, self._from_templates = diameter_m, from_templates
        self._renderer = Renderer([mesh], [0], CROP_PX, CROP_PX, ambient=AMBIENT)

    @classmethod
    def in_world(cls, world: World, *, from_templates: bool = False) -> "RenderAndCompare":
        """Build the refiner for a world's object and camera; templates show the object as thick as the real one.

        Raises:
            UsageError: The world does not have one object before a pinhole camera.
        """
        if not isinstance(world, SingleObjectWorld):
            raise UsageError(
                f"--refine: world {world.name} cannot be refined, expected objects in free space before a "
                "camera (linemod, capture without --plane); leave it out"
            )
        object_ = world.object.without_scan_excess() if from_templates else world.object
        return cls(object_.mesh, world.camera, object_.kind.diameter_m, from_templates=from_templates)

    def refine(self, images: Tensor, code: SceneCode) -> Refined:
        """Refine the poses of a batch, all at once.

        Args:
            images: uint8 sRGB [batch, 3, height, width].
            code: Estimates for them; metres and 6D rotation in the camera frame.
        """
        *_, (result, residual) = self.steps(images, code)
        accepted = self._accepted(images, code, result)
        refined = {
            name: torch.where(accepted[:, None, None], result[name], code[name]) for name in (TRANSLATION, ROTATION_6D)
        }
        found = dict(code) | refined
        code = with_mean_depth(code, found) if self._from_templates else found
        return Refined(code, accepted, residual, result[LIGHT])

    def steps(self, images: Tensor, code: SceneCode) -> Iterator[tuple[dict[str, Tensor], Float[Tensor, " batch"]]]:
        """The code after each step of the optimisation, and the mean residual before the step, 0 to 1.

        Arguments are those of :meth:`refine`. Residuals of different rounds are behind different blurs.
        """
        result = dict(code)
        for number in range(len(_ROUNDS)):
            for update, residual in self._round(images, result, number):
                found = result | update
                yield found, residual
            result = found

    @torch.no_grad()
    def inlier_ratio(self, images: Tensor, code: SceneCode) -> Float[Tensor, " batch"]:
        """Fraction of the silhouette that poses explain and the background alone does not, without optimising them.

        Arguments are those of :meth:`refine`.
        """
        ratios = []
        for first in range(0, len(images), _BATCH_SIZE):
            rows = slice(first, first + _BATCH_SIZE)
            part = index(code, rows)
            part[LIGHT] = part[LIGHT].new_tensor(DEFAULT_LIGHT).expand_as(part[LIGHT])
            crops = self._crops(images[rows], part, _ROUNDS[0].margin_px).blurred(1)
            estimate = crops.from_code(part)
            residual = crops.residual(self._rendered(crops, estimate, self._gain_and_offset(crops, estimate)))
            silhouette, _ = self._silhouette(crops, estimate)
            ratios.append(crops.inlier_pixels(residual) / silhouette.sum((1, 2, 3)).clamp(min=1))
        return torch.cat(ratios)

    def in_view(self, translation_m: Float[np.ndarray, "num 3"]) -> Bool[np.ndarray, " num"]:
        """Whether positions in the camera frame project into the frame, at more than a diameter's distance."""
        depth = translation_m[:, 2:]
        pixels = (translation_m @ self._matrix.double().numpy().T)[:, :2] / np.maximum(depth, 1e-6)
        inside = (pixels >= 0).all(axis=1) & (pixels < [self._camera.width, self._camera.height]).all(axis=1)
        visible: np.ndarray = inside & (depth[:, 0] > self.diameter_m)
        return visible

    def _round(
        self, images: Tensor, code: SceneCode, number: int
    ) -> Iterator[tuple[dict[str, Tensor], Float[Tensor, " batch"]]]:
        """Pose and light after each step of one round, and the mean residual before it."""
        times, margin_px = _ROUNDS[number]
        crops = self._crops(images, code, margin_px).blurred(times)
        start, update = crops.from_code(code), PoseUpdate.zero(len(images))
        groups = [{"params": [value], "lr": _LEARNING_RATES[name]} for name, value in vars(update).items()]
        optimizer = torch.optim.Adam(groups, betas=_BETAS)
        done = [(number * _STEPS + step) / (len(_ROUNDS) * _STEPS) for step in range(_STEPS + 1)]
        rates = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: (1 + math.cos(math.pi * done[step])) / 2)
        gain_and_offset = self._gain_and_offset(crops, start)
        for _ in range(_STEPS):
            optimizer.zero_grad()
            estimate = start.updated(update, self.diameter_m)
            residual = crops.mean_residual(crops.residual(self._rendered(crops, estimate, gain_and_offset)))
            residual.sum().backward()
            optimizer.step()
            rates.step()
            with torch.no_grad():
                result = crops.to_code(start.updated(update, self.diameter_m))
            yield result, residual.detach()

    @torch.no_grad()
    def _crops(self, images: Tensor, code: SceneCode, margin_px: int) -> Crops:
        """The crops around estimates, and the inpainted backgrounds."""
        position_m = code[TRANSLATION][:, 0]
        focal_px = FILL * CROP_PX * position_m.norm(dim=1) / self.diameter_m
        found, crop_from_cam = cut_crops(images.float() / 255, self._matrix, position_m[:, None], focal_px, CROP_PX)
        matrices = crop_matrices(focal_px.numpy(), CROP_PX)
        crops = Crops(found, found, found.new_zeros(len(found), 1, 1, 1), crop_from_cam, matrices, code.get(COLOR))
        silhouette, _ = self._silhouette(crops, crops.from_code(code))
        masked = dilated(silhouette, margin_px) > 0.1
        return replace(crops, backgrounds=inpainted(found, masked), mask=dilated(masked.float(), 2))

    def _draw(self, crops: Crops, estimate: PoseAndLight, backgrounds: Tensor) -> Tensor:
        images: Tensor = self._renderer(
            estimate.rotation[:, None],
            estimate.translation_m[:, None],
            camera_matrix=crops.matrices,
            backgrounds=backgrounds,
            light=estimate.light,
            color=crops.color,
        )
        return images

    @torch.no_grad()
    def _silhouette(self, crops: Crops, estimate: PoseAndLight) -> tuple[Tensor, Tensor]:
        """The object's silhouette [batch, 1, side, side], and the object over black."""
        black = torch.zeros_like(crops.images)
        over_black, over_white = (self._draw(crops, estimate, backgrounds) for backgrounds in (black, black + 1))
        return (1 - (over_white - over_black)).mean(1, keepdim=True).clamp(0, 1), over_black

    @torch.no_grad()
    def _gain_and_offset(self, crops: Crops, estimate: PoseAndLight) -> tuple[Tensor, Tensor]:
        """Gain [batch, 1, 1, 1] and offset [batch, 3, 1, 1] that fit the rendering to the crop.

        Least squares inside the silhouette, one gain for all channels.
        """
        silhouette, over_black = self._silhouette(crops, estimate)
        inside = (F.avg_pool2d(silhouette, 3, 1, 1) > 0.99).float()
        weight = inside / inside.sum((2, 3), keepdim=True).clamp(min=1)
        means = [(image * weight).sum((2, 3), keepdim=True) for image in (over_black, crops.images)]
        rendered, seen = (image - mean for image, mean in zip((over_black, crops.images), means, strict=True))
        covariance, variance = ((rendered * other * weight).sum((2, 3)).mean(1) for other in (seen, rendered))
        gain = ((covariance + _MIN_VARIANCE) / (variance + _MIN_VARIANCE)).clamp(_MIN_GAIN, _MAX_GAIN)
        gain = gain[:, None, None, None]
        return gain, means[1] - gain * means[0]

    def _rendered(self, crops: Crops, estimate: PoseAndLight, gain_and_offset: tuple[Tensor, Tensor]) -> Tensor:
        """The object over the background, blurred like the crops."""
        gain, offset = gain_and_offset
        # Gain and offset apply to the object alone: the background goes through their inverse first.
        image = self._draw(crops, estimate, (crops.backgrounds - offset) / gain)
        for _ in range(crops.times_blurred):
            image = blurred(image)
        return image * gain + offset

    @torch.no_grad()
    def _accepted(self, images: Tensor, code: SceneCode, result: SceneCode) -> Bool[Tensor, " batch"]:
        """Which results may replace the estimates, both judged on the crops of the first round."""
        crops = self._crops(images, code, _ROUNDS[0].margin_px)
        before, after = crops.from_code(code), crops.from_code(result)
        residuals = [
            crops.residual(self._rendered(crops, estimate, self._gain_and_offset(crops, estimate)))
            for estimate in (before, after)
        ]
        silhouette, _ = self._silhouette(crops, after)
        log_depth = (after.translation_m[:, 2:] / before.translation_m[:, 2:]).log()[:, 0]
        offset = (after.translation_m[:, :2] / (self.diameter_m * log_depth.exp()[:, None])).norm(dim=1)
        accepted = rotation_angle_deg(after.rotation, before.rotation) < MAX_ROTATION_DEG
        accepted &= (offset < MAX_OFFSET) & (log_depth.abs() < MAX_LOG_DEPTH)
        accepted &= crops.inlier_pixels(residuals[1]) > MIN_INLIER_RATIO * silhouette.sum((1, 2, 3))
        return accepted & (crops.mean_residual(residuals[1]) < crops.mean_residual(residuals[0]))
