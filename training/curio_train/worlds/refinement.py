"""Render and compare: poses read by a network, moved until their renderings look like the picture.

A crop around each estimate is explained as the object over a background. No clean background exists, so it is filled in
from around the silhouette: what lies between a silhouette and the true outline is then either object drawn where the
picture shows background, or background where it shows the object, and both pull the outline to its place. Brightness
and contrast are the picture's own (least squares inside the silhouette). The difference is robust and redescending
(Geman and McClure 1987): things in front, and whatever the background was not, weigh nothing instead of pulling.

Pose and light move by Adam, first on blurred pictures, then on sharp ones, all of a batch at once. An answer counts
only if it explains the picture better than the estimate did, lies near the estimate, and enough of it can be seen: much
of the silhouette must be what the background alone does not explain. Else the estimate stands.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from curio_train.camera import gaze_at, sampling_grid
from curio_train.errors import UsageError
from curio_train.geometry import matrix_from_rotation_6d, rotation_6d_from_matrix, rotation_angle_deg
from curio_train.rendering.renderer import Renderer
from curio_train.scene_code import COLOR, LIGHT, ROTATION_6D, TRANSLATION, SceneCode
from curio_train.worlds.base import World
from curio_train.worlds.single_object import SingleObjectWorld
from curio_train.worlds.views import AMBIENT

CROP_PX, FILL = 96, 0.6
"""Side of the crop, and the share of it that the object's diameter spans."""

LARGEST_TURN_DEG, LARGEST_SHIFT, LARGEST_LOG_DEPTH = 25.0, 0.3, 0.15
"""How far an answer may lie from the estimate: rotation, diameters across the view, logarithm of the depth."""

_BLURS = (2, 1, 0)  # times that the pictures are blurred in each round
_STEPS = 12  # a round
_LEARNING_RATES = {"across": 0.01, "log_depth": 0.015, "turn": 0.03, "light": 0.05}
_BETAS = (0.8, 0.95)  # of Adam: there are few steps
_SCALE = 0.09  # difference of sRGB colours at which a pixel pulls hardest
_MARGIN_PX = 6  # around the silhouette, where the background is filled in
LEAST_SEEN = 0.4
"""Of the silhouette: 0.55 to 0.9 where the object is whole in view, below 0.4 on clutter alone."""

_GAINS = (0.4, 2.0)
_EVEN_LIGHT = 0.0, -0.4, -0.5  # from above the camera, where nothing adapts the light that was read
_AT_ONCE = 32  # images, where nothing is learned
_FLAT = 0.002  # variance of colours below which contrast cannot be told


def refined(predict: Callable[[Tensor], SceneCode], world: World) -> Callable[[Tensor], dict[str, Tensor]]:
    """A reader whose poses are refined.

    Args:
        predict: uint8 images [batch, 3, height, width] of the world's camera to scene codes.
        world: Of one object.

    Raises:
        UsageError: The world is another.
    """
    refine = Refinement(world)
    return lambda images: refine(images, predict(images))


class Refinement:
    """Refines poses of one object in pictures of a world's camera.

    Attributes:
        diameter_m: Of the object.
    """

    def __init__(self, world: World) -> None:
        """Build the renderer.

        Raises:
            UsageError: The world does not have one object before a pinhole camera.
        """
        if not isinstance(world, SingleObjectWorld):
            raise UsageError(
                f"--refine: world {world.name} cannot be refined, expected one object before a camera (linemod, "
                "capture); leave it out"
            )
        self._camera = world.camera
        self._matrix = torch.from_numpy(np.asarray(world.camera.matrix)).float()[None]
        self.diameter_m = world.object.kind.diameter_m
        self._renderer = Renderer([world.object.mesh], [0], CROP_PX, CROP_PX, ambient=AMBIENT)

    def __call__(self, images: Tensor, code: SceneCode) -> dict[str, Tensor]:
        """Better poses, where they are found; all else as in :meth:`judged`."""
        return self.judged(images, code)[0]

    def judged(self, images: Tensor, code: SceneCode) -> tuple[dict[str, Tensor], Bool[Tensor, " batch"]]:
        """Better poses, and where they are found.

        Args:
            images: uint8 sRGB [batch, 3, height, width].
            code: What was read in them; metres and 6D rotation in the camera's frame.

        Returns:
            The code with positions and rotations refined, everything else as it was; and which were.
        """
        view = self._view(images, code)
        start = _Moves.none(len(images), code[LIGHT])
        moves = _Moves(*(value.clone().requires_grad_() for value in vars(start).values()))
        groups = [{"params": [value], "lr": _LEARNING_RATES[name]} for name, value in vars(moves).items()]
        optimizer = torch.optim.Adam(groups, betas=_BETAS)
        rates = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, _STEPS * len(_BLURS))
        for times in _BLURS:
            picture = view.blurred(times)
            response = self._response(picture, moves)
            for _ in range(_STEPS):
                optimizer.zero_grad()
                picture.share(picture.missed(self._rendered(picture, moves, response))).sum().backward()
                optimizer.step()
                rates.step()
        return self._accepted(view, start, moves, code)

    @torch.no_grad()
    def explained(self, images: Tensor, code: SceneCode) -> Float[Tensor, " batch"]:
        """Share of the silhouettes that poses as they are explain, and the backgrounds alone do not.

        Arguments are those of :meth:`judged`.
        """
        shares = []
        for first in range(0, len(images), _AT_ONCE):
            part = {name: value[first : first + _AT_ONCE] for name, value in code.items()}
            part[LIGHT] = part[LIGHT].new_tensor(_EVEN_LIGHT).expand_as(part[LIGHT])
            view = self._view(images[first : first + _AT_ONCE], part).blurred(1)
            still = _Moves.none(len(view.crops), part[LIGHT])
            missed = view.missed(self._rendered(view, still, self._response(view, still)))
            silhouette, _ = self._object(view, still)
            shares.append(view.explained(missed) / silhouette.sum((1, 2, 3)).clamp(min=1))
        return torch.cat(shares)

    def in_view(self, translation_m: Float[np.ndarray, "num 3"]) -> Bool[np.ndarray, " num"]:
        """Whether positions in the camera's frame are seen within the frame."""
        depth = translation_m[:, 2:]
        pixels = (translation_m @ self._matrix[0].double().numpy().T)[:, :2] / np.maximum(depth, 1e-6)
        inside = (pixels >= 0).all(axis=1) & (pixels < [self._camera.width, self._camera.height]).all(axis=1)
        seen: np.ndarray = inside & (depth[:, 0] > self.diameter_m)
        return seen

    def _view(self, images: Tensor, code: SceneCode) -> "_View":
        """The crops around the estimates, and the backgrounds behind them."""
        place = code[TRANSLATION][:, 0]
        depth, frames = place.norm(dim=1), self._matrix.expand(len(place), 3, 3)
        focal = FILL * CROP_PX * depth / self.diameter_m
        gaze = gaze_at(place, 2 * focal, 2 * CROP_PX, frames)  # two samples a pixel and side, then averaged
        grid = sampling_grid(gaze, frames, 2 * CROP_PX, images.shape[3], images.shape[2])
        fine = F.grid_sample(images.float() / 255, grid, padding_mode="border", align_corners=False)
        crops = F.avg_pool2d(fine, 2)
        matrices = np.zeros((len(place), 3, 3))
        matrices[:, 0, 0] = matrices[:, 1, 1] = focal.numpy()
        matrices[:, [0, 1], 2] = (CROP_PX - 1) / 2
        matrices[:, 2, 2] = 1
        rotation = gaze.rotation @ matrix_from_rotation_6d(code[ROTATION_6D][:, 0])
        color = code.get(COLOR)
        view = _View(crops, crops, torch.zeros(len(place), 1, 1, 1), gaze.rotation, matrices, rotation, depth, color, 0)
        silhouette, _ = self._object(view, _Moves.none(len(place), code[LIGHT]))
        hidden = _grown(silhouette, _MARGIN_PX) > 0.1
        return view.over(filled_in(crops, hidden), _grown(hidden.float(), 2))

    def _draw(self, view: "_View", moves: "_Moves", behind: Tensor) -> Tensor:
        rotation, translation_m = self._pose(view, moves)
        images: Tensor = self._renderer(
            rotation[:, None],
            translation_m[:, None],
            camera_matrix=view.matrices,
            backgrounds=behind,
            light=(view.crop_from_cam @ moves.light[..., None])[..., 0],
            color=view.color,
        )
        return images

    def _pose(self, view: "_View", moves: "_Moves") -> tuple[Tensor, Tensor]:
        """cam_from_obj of the crop's camera."""
        depth = view.depth_m[:, None] * moves.log_depth.exp()
        across = moves.across * self.diameter_m * moves.log_depth.exp()
        return rotation_from_vector(moves.turn) @ view.rotation, torch.cat([across, depth], dim=1)

    @torch.no_grad()
    def _object(self, view: "_View", moves: "_Moves") -> tuple[Tensor, Tensor]:
        """Its silhouette [batch, 1, side, side] and itself over black."""
        black = torch.zeros_like(view.crops)
        over_black, over_white = (self._draw(view, moves, behind) for behind in (black, black + 1))
        return (1 - (over_white - over_black)).mean(1, keepdim=True).clamp(0, 1), over_black

    @torch.no_grad()
    def _response(self, view: "_View", moves: "_Moves") -> tuple[Tensor, Tensor]:
        """Contrast [batch, 1, 1, 1] and brightness [batch, 3, 1, 1] that make the rendering the picture.

        Least squares inside the silhouette, one contrast for all channels.
        """
        silhouette, drawn = self._object(view, moves)
        inside = (F.avg_pool2d(silhouette, 3, 1, 1) > 0.99).float()
        share = inside / inside.sum((2, 3), keepdim=True).clamp(min=1)
        means = [(image * share).sum((2, 3), keepdim=True) for image in (drawn, view.crops)]
        rendered, seen = (image - mean for image, mean in zip((drawn, view.crops), means, strict=True))
        together, own = ((rendered * other * share).sum((2, 3)).mean(1) for other in (seen, rendered))
        contrast = ((together + _FLAT) / (own + _FLAT)).clamp(*_GAINS)[:, None, None, None]
        return contrast, means[1] - contrast * means[0]

    def _rendered(self, view: "_View", moves: "_Moves", response: tuple[Tensor, Tensor]) -> Tensor:
        """What the crops should look like."""
        contrast, brightness = response
        # Dividing the response out of the background is the same as applying it to the object alone.
        image = self._draw(view, moves, (view.behind - brightness) / contrast)
        for _ in range(view.times_blurred):
            image = _blurred(image)
        return image * contrast + brightness

    @torch.no_grad()
    def _accepted(
        self, view: "_View", start: "_Moves", moves: "_Moves", code: SceneCode
    ) -> tuple[dict[str, Tensor], Tensor]:
        """The code with the poses that may replace the estimates, and which do."""
        before, after = (view.missed(self._rendered(view, m, self._response(view, m))) for m in (start, moves))
        silhouette, _ = self._object(view, moves)
        rotation, translation_m = self._pose(view, moves)
        near = rotation_angle_deg(rotation, view.rotation) < LARGEST_TURN_DEG
        near &= moves.across.norm(dim=1) < LARGEST_SHIFT
        near &= moves.log_depth[:, 0].abs() < LARGEST_LOG_DEPTH
        near &= view.explained(after) > LEAST_SEEN * silhouette.sum((1, 2, 3))
        taken = near & (view.share(after) < view.share(before))
        back = view.crop_from_cam.transpose(1, 2)
        found = {
            TRANSLATION: (back @ translation_m[..., None]).transpose(1, 2),
            ROTATION_6D: rotation_6d_from_matrix(back @ rotation)[:, None],
        }
        better = {name: torch.where(taken[:, None, None], value, code[name]) for name, value in found.items()}
        return dict(code) | better, taken


@dataclass(frozen=True, eq=False)
class _Moves:
    """What changes of a scene.

    Attributes:
        across: [batch, 2], diameters.
        log_depth: [batch, 1].
        turn: [batch, 3], rotation vector in the crop's camera, radians.
        light: [batch, 3], the frame's camera.
    """

    across: Tensor
    log_depth: Tensor
    turn: Tensor
    light: Tensor

    @staticmethod
    def none(count: int, light: Tensor) -> "_Moves":
        return _Moves(torch.zeros(count, 2), torch.zeros(count, 1), torch.zeros(count, 3), light.float())


@dataclass(frozen=True, eq=False)
class _View:
    """Crops, and how estimates lie in them.

    Attributes:
        crops: [batch, 3, side, side].
        behind: The same without the object.
        region: [batch, 1, side, side], where they are compared: 1 inside and around the silhouette, else 0.
        crop_from_cam: [batch, 3, 3].
        matrices: K of each crop.
        rotation: crop_from_obj as estimated.
        depth_m: Of the estimates; they lie on the crop's axis.
        color: Of unpainted objects, [batch, 1, 3].
        times_blurred: How often crops and backgrounds are.
    """

    crops: Tensor
    behind: Tensor
    region: Tensor
    crop_from_cam: Tensor
    matrices: np.ndarray
    rotation: Tensor
    depth_m: Tensor
    color: Tensor | None
    times_blurred: int

    def over(self, behind: Tensor, region: Tensor) -> "_View":
        """The same before another background."""
        return _View(**(vars(self) | {"behind": behind, "region": region}))

    def blurred(self, times: int) -> "_View":
        """The same, blurred."""
        crops, behind = self.crops, self.behind
        for _ in range(times):
            crops, behind = _blurred(crops), _blurred(behind)
        return _View(**(vars(self) | {"crops": crops, "behind": behind, "times_blurred": times}))

    def missed(self, images: Tensor) -> Float[Tensor, "batch 1 side side"]:
        """Robust difference between images and crops, 0 to 1 a pixel; 0 outside the region."""
        squared = ((images - self.crops) / _SCALE).square().sum(1, keepdim=True)
        return squared / (squared + 1) * self.region

    def explained(self, missed: Tensor) -> Float[Tensor, " batch"]:
        """By how much less is missed than by the background alone, pixels."""
        return (self.missed(self.behind) - missed).clamp(min=0).sum((1, 2, 3))

    def share(self, missed: Tensor) -> Float[Tensor, " batch"]:
        """Its mean over the region."""
        return missed.sum((1, 2, 3)) / self.region.sum((1, 2, 3)).clamp(min=1)


def rotation_from_vector(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rodrigues' formula; the gradient is finite at 0."""
    angle = (vector.square().sum(-1) + 1e-12).sqrt()[..., None, None]
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    identity = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return identity + angle.sin() / angle * cross + (1 - angle.cos()) / angle.square() * (cross @ cross)


def filled_in(images: Float[Tensor, "b c h w"], hidden: Tensor) -> Float[Tensor, "b c h w"]:
    """Images whose hidden pixels [b, 1, h, w] continue what is around them.

    From coarse to fine: each level takes what it can see as it is and the rest from the level above it (pull-push,
    Gortler et al. 1996, "The Lumigraph").
    """
    seen = (~hidden).float()
    levels = [(images * seen, seen)]
    for _ in range(math.ceil(math.log2(max(images.shape[-2:])))):
        total, weight = (F.avg_pool2d(value, 2, ceil_mode=True) for value in levels[-1])
        levels.append((total, weight))
    total, weight = levels.pop()
    filled = total / weight.clamp(min=1e-6)
    for total, weight in reversed(levels):
        above = F.interpolate(filled, total.shape[-2:], mode="bilinear", align_corners=False)
        filled = torch.where(weight > 0, total / weight.clamp(min=1e-6), above)
    return filled


def _grown(mask: Tensor, pixels: int) -> Tensor:
    return F.max_pool2d(mask, 2 * pixels + 1, 1, pixels)


def _blurred(images: Tensor) -> Tensor:
    """By a binomial filter of five pixels each way."""
    for axis in (-2, -1):
        padding = (0, 0, 2, 2) if axis == -2 else (2, 2, 0, 0)
        wide = F.pad(images, padding, mode="replicate")
        taps = [wide.narrow(axis, first, images.shape[axis]) for first in range(5)]
        images = (taps[0] + taps[4] + 4 * (taps[1] + taps[3]) + 6 * taps[2]) / 16
    return images
