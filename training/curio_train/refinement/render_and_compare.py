"""Render and compare: poses read by a network, moved until their renderings look like the picture.

A crop around each estimate is explained as the object over a background. No clean background exists, so it is filled in
from around the silhouette: what lies between a silhouette and the true outline is then either object drawn where the
picture shows background, or background where it shows the object, and both pull the outline to its place. Brightness
and contrast are the picture's own (least squares inside the silhouette). The difference is robust and redescending
(Geman and McClure 1987): things in front, and whatever the background was not, weigh nothing instead of pulling.

Pose and light move by Adam, first on blurred pictures, then on sharp ones, all of a batch at once; before each round
the background is filled in anew, closer and closer to the silhouette. An answer counts
only if it explains the picture better than the estimate did, lies near the estimate, and enough of it can be seen: much
of the silhouette must be what the background alone does not explain. Else the estimate stands.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from curio_train.errors import UsageError
from curio_train.geometry import rotation_angle_deg
from curio_train.networks.crop_camera import crop_camera_at, sampling_grid
from curio_train.refinement.crops import Moves, Scene, View
from curio_train.refinement.inpainting import blurred, filled_in, grown
from curio_train.rendering.renderer import Renderer
from curio_train.scene_code import COLOR, LIGHT, ROTATION_6D, TRANSLATION, SceneCode
from curio_train.worlds.base import World
from curio_train.worlds.single_object.viewpoints import AMBIENT
from curio_train.worlds.single_object.world import SingleObjectWorld

CROP_PX, FILL = 96, 0.6
"""Side of the crop, and the share of it that the object's diameter spans."""

LARGEST_TURN_DEG, LARGEST_SHIFT, LARGEST_LOG_DEPTH = 25.0, 0.3, 0.15
"""How far an answer may lie from the estimate: rotation, diameters across the view, logarithm of the depth."""


class _Round(NamedTuple):
    """How a round sees the picture.

    Attributes:
        times_blurred: As often.
        margin_px: Around the silhouette of what the round begins with, where the background is filled in. What is
            filled in is no true background: over clutter, drawing an object larger than it is costs less than drawing
            it smaller, and what is read comes out too near, the more the wider the margin (decision 66).
    """

    times_blurred: int
    margin_px: int


_ROUNDS = (_Round(2, 2), _Round(1, 1), _Round(0, 1), _Round(0, 1))
_STEPS = 12  # a round
_LEARNING_RATES = {"across": 0.01, "log_depth": 0.015, "turn": 0.03, "light": 0.05}
_BETAS = (0.8, 0.95)  # of Adam: there are few steps
LEAST_SEEN = 0.3
"""Of the silhouette: more in most renderings where the object is (0.5 to 0.9), less on nine of ten of clutter alone."""

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
    refine = RenderAndCompare(world)
    return lambda images: refine(images, predict(images))


class RenderAndCompare:
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
        found = dict(code)
        for number in range(len(_ROUNDS)):
            found |= self._round(images, found, number)
        taken = self._accepted(images, code, found)
        better = {
            name: torch.where(taken[:, None, None], found[name], code[name]) for name in (TRANSLATION, ROTATION_6D)
        }
        return dict(code) | better, taken

    def _round(self, images: Tensor, code: SceneCode, number: int) -> dict[str, Tensor]:
        """Pose and light after one of the rounds."""
        times, margin_px = _ROUNDS[number]
        view = self._view(images, code, margin_px).blurred(times)
        start = view.scene(code)
        moves = Moves.none(len(images))
        groups = [{"params": [value], "lr": _LEARNING_RATES[name]} for name, value in vars(moves).items()]
        optimizer = torch.optim.Adam(groups, betas=_BETAS)
        done = [(number * _STEPS + step) / (len(_ROUNDS) * _STEPS) for step in range(_STEPS + 1)]
        rates = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: (1 + math.cos(math.pi * done[step])) / 2)
        response = self._response(view, start)
        for _ in range(_STEPS):
            optimizer.zero_grad()
            scene = start.moved(moves, self.diameter_m)
            view.share(view.missed(self._rendered(view, scene, response))).sum().backward()
            optimizer.step()
            rates.step()
        with torch.no_grad():
            return view.code(start.moved(moves, self.diameter_m))

    @torch.no_grad()
    def explained(self, images: Tensor, code: SceneCode) -> Float[Tensor, " batch"]:
        """Share of the silhouettes that poses as they are explain, and the backgrounds alone do not.

        Arguments are those of :meth:`judged`.
        """
        shares = []
        for first in range(0, len(images), _AT_ONCE):
            part = {name: value[first : first + _AT_ONCE] for name, value in code.items()}
            part[LIGHT] = part[LIGHT].new_tensor(_EVEN_LIGHT).expand_as(part[LIGHT])
            view = self._view(images[first : first + _AT_ONCE], part, _ROUNDS[0].margin_px).blurred(1)
            scene = view.scene(part)
            missed = view.missed(self._rendered(view, scene, self._response(view, scene)))
            silhouette, _ = self._object(view, scene)
            shares.append(view.explained(missed) / silhouette.sum((1, 2, 3)).clamp(min=1))
        return torch.cat(shares)

    def in_view(self, translation_m: Float[np.ndarray, "num 3"]) -> Bool[np.ndarray, " num"]:
        """Whether positions in the camera's frame are seen within the frame."""
        depth = translation_m[:, 2:]
        pixels = (translation_m @ self._matrix[0].double().numpy().T)[:, :2] / np.maximum(depth, 1e-6)
        inside = (pixels >= 0).all(axis=1) & (pixels < [self._camera.width, self._camera.height]).all(axis=1)
        seen: np.ndarray = inside & (depth[:, 0] > self.diameter_m)
        return seen

    @torch.no_grad()
    def _view(self, images: Tensor, code: SceneCode, margin_px: int) -> View:
        """The crops around the estimates, and the backgrounds behind them."""
        place = code[TRANSLATION][:, 0]
        depth, frames = place.norm(dim=1), self._matrix.expand(len(place), 3, 3)
        focal = FILL * CROP_PX * depth / self.diameter_m
        gaze = crop_camera_at(place, 2 * focal, 2 * CROP_PX, frames)  # two samples a pixel and side, then averaged
        grid = sampling_grid(gaze, frames, 2 * CROP_PX, images.shape[3], images.shape[2])
        fine = F.grid_sample(images.float() / 255, grid, padding_mode="border", align_corners=False)
        crops = F.avg_pool2d(fine, 2)
        matrices = np.zeros((len(place), 3, 3))
        matrices[:, 0, 0] = matrices[:, 1, 1] = focal.numpy()
        matrices[:, [0, 1], 2] = (CROP_PX - 1) / 2
        matrices[:, 2, 2] = 1
        view = View(crops, crops, torch.zeros(len(place), 1, 1, 1), gaze.rotation, matrices, code.get(COLOR), 0)
        silhouette, _ = self._object(view, view.scene(code))
        hidden = grown(silhouette, margin_px) > 0.1
        return view.over(filled_in(crops, hidden), grown(hidden.float(), 2))

    def _draw(self, view: View, scene: Scene, behind: Tensor) -> Tensor:
        images: Tensor = self._renderer(
            scene.rotation[:, None],
            scene.translation_m[:, None],
            camera_matrix=view.matrices,
            backgrounds=behind,
            light=scene.light,
            color=view.color,
        )
        return images

    @torch.no_grad()
    def _object(self, view: View, scene: Scene) -> tuple[Tensor, Tensor]:
        """Its silhouette [batch, 1, side, side] and itself over black."""
        black = torch.zeros_like(view.crops)
        over_black, over_white = (self._draw(view, scene, behind) for behind in (black, black + 1))
        return (1 - (over_white - over_black)).mean(1, keepdim=True).clamp(0, 1), over_black

    @torch.no_grad()
    def _response(self, view: View, scene: Scene) -> tuple[Tensor, Tensor]:
        """Contrast [batch, 1, 1, 1] and brightness [batch, 3, 1, 1] that make the rendering the picture.

        Least squares inside the silhouette, one contrast for all channels.
        """
        silhouette, drawn = self._object(view, scene)
        inside = (F.avg_pool2d(silhouette, 3, 1, 1) > 0.99).float()
        share = inside / inside.sum((2, 3), keepdim=True).clamp(min=1)
        means = [(image * share).sum((2, 3), keepdim=True) for image in (drawn, view.crops)]
        rendered, seen = (image - mean for image, mean in zip((drawn, view.crops), means, strict=True))
        together, own = ((rendered * other * share).sum((2, 3)).mean(1) for other in (seen, rendered))
        contrast = ((together + _FLAT) / (own + _FLAT)).clamp(*_GAINS)[:, None, None, None]
        return contrast, means[1] - contrast * means[0]

    def _rendered(self, view: View, scene: Scene, response: tuple[Tensor, Tensor]) -> Tensor:
        """What the crops should look like."""
        contrast, brightness = response
        # Dividing the response out of the background is the same as applying it to the object alone.
        image = self._draw(view, scene, (view.behind - brightness) / contrast)
        for _ in range(view.times_blurred):
            image = blurred(image)
        return image * contrast + brightness

    @torch.no_grad()
    def _accepted(self, images: Tensor, code: SceneCode, found: SceneCode) -> Bool[Tensor, " batch"]:
        """Which of the poses that were found may replace the estimates, both seen as the first round sees them."""
        view = self._view(images, code, _ROUNDS[0].margin_px)
        before, after = view.scene(code), view.scene(found)
        missed = [view.missed(self._rendered(view, scene, self._response(view, scene))) for scene in (before, after)]
        silhouette, _ = self._object(view, after)
        depth = after.translation_m[:, 2:]
        log_depth = (depth / before.translation_m[:, 2:]).log()[:, 0]
        across = (after.translation_m[:, :2] / (self.diameter_m * log_depth.exp()[:, None])).norm(dim=1)
        near = rotation_angle_deg(after.rotation, before.rotation) < LARGEST_TURN_DEG
        near &= (across < LARGEST_SHIFT) & (log_depth.abs() < LARGEST_LOG_DEPTH)
        near &= view.explained(missed[1]) > LEAST_SEEN * silhouette.sum((1, 2, 3))
        return near & (view.share(missed[1]) < view.share(missed[0]))
