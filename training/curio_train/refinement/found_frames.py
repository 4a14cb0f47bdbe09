"""Poses found in frames whose scene codes nobody tells, and what both stages of a detector learn from them.

It is the search of ``--method hypotheses`` in six degrees of freedom. The hypotheses are the object's renderings from
all sides, compared with the frame by pretrained features (:mod:`~curio_train.networks.templates.network`); the best
ones descend the gradient of the image loss (:mod:`~curio_train.refinement.render_and_compare`); and a pose is kept only
where its rendering then explains the frame. Neither a code of a frame nor a rendering of a known code teaches the
network.
"""

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import UInt8
from torch import Tensor

from curio_train.camera import scale_matrix
from curio_train.errors import TrainingError
from curio_train.metrics.poses import in_view
from curio_train.networks.templates.network import TemplateNetwork
from curio_train.refinement.pseudo_labels import PseudoLabels
from curio_train.refinement.render_and_compare import RenderAndCompare
from curio_train.refinement.turned_frames import LARGEST_ROLL_DEG, random_camera, seen_by
from curio_train.scene_code import CONFIDENCE, LIGHT, TRANSLATION, SceneCode, index, joined
from curio_train.templates.build import fill, template_network
from curio_train.worlds.base import Batch, ImageSource
from curio_train.worlds.single_object.crop_pose_stage import ABSENT_FRACTION
from curio_train.worlds.single_object.localisation_stage import LOCALISATION_STRIDE
from curio_train.worlds.single_object.two_stage import TwoStageWorld

NUM_FRAMES = 3000
LARGEST_RESIDUAL = 0.12
"""Largest residual of poses that are kept.

Among 144 frames of the ape, whose codes were opened to see what goes wrong, 48 % had such a residual, and 96 % of these
poses were right by ADD < 0.1 d (docs/experiments/linemod.md)."""

_BATCH = 20
_HALVED = 2  # frames are turned at half their size: localisation sees a quarter


class TrainingFrames:
    """The first frames of a world's training images, without their codes, rendered when they are asked for."""

    def __init__(self, world: TwoStageWorld, seed: int, cache: Path, num: int = NUM_FRAMES) -> None:
        """Render nothing yet.

        Args:
            world: That draws and renders them.
            seed: Of the draws.
            cache: Folder of the image sets that worlds draw once.
            num: How many.

        Raises:
            DataError: The backgrounds cannot be read.
        """
        self._stream, self._num = world.source("train", seed, with_code=False, cache=cache), num

    def __len__(self) -> int:
        return self._num

    def __getitem__(self, rows: slice) -> UInt8[Tensor, "num 3 height width"]:
        """Neighbouring frames, sRGB."""
        first, last, _ = rows.indices(self._num)
        images = [self._stream.batch(number, 1).images for number in range(first, last)]
        return (torch.cat(images).clamp(0, 1) * 255).round().byte()


class FrameExplainer:
    """Finds the object in frames."""

    def __init__(self, world: TwoStageWorld, read: Callable[[Tensor], SceneCode]) -> None:
        """Build the renderer.

        Args:
            world: Of the object.
            read: Frames [1, 3, height, width] in [0, 1] to the best of the hypotheses, see :func:`template_reader`.
        """
        self._read, self._refiner = read, RenderAndCompare.in_world(world)

    @torch.no_grad()
    def explain(self, images: UInt8[Tensor, "batch 3 height width"]) -> dict[str, Tensor]:
        """The codes found in frames, with a confidence of 0 where nothing explains the frame well enough."""
        return joined([self._explained(chunk) for chunk in images.split(_BATCH)])

    def _explained(self, images: Tensor) -> dict[str, Tensor]:
        estimate = joined([self._read(image[None].float() / 255) for image in images])
        with torch.enable_grad():
            refined = self._refiner.refine(images, estimate)
        explains = refined.accepted & (refined.residual < LARGEST_RESIDUAL)
        return refined.code | {LIGHT: refined.light, CONFIDENCE: explains.float()[:, None, None]}


def template_reader(world: TwoStageWorld, cache: Path) -> Callable[[Tensor], SceneCode]:
    """A function that compares frames with renderings of the object from all sides, drawn when the first frame comes.

    It raises CheckpointError if the weights of the pretrained features are missing.

    Args:
        world: Of the object.
        cache: Folder of the image sets that worlds draw once.
    """

    @lru_cache(maxsize=1)
    def drawn() -> TemplateNetwork:
        network = template_network(world)
        fill(network, world, cache, torch.get_num_threads())
        return network

    return lambda images: drawn()(images)


def stage_sources(world: TwoStageWorld, frames: TrainingFrames, code: SceneCode, seed: int) -> list[ImageSource]:
    """The images that each stage learns from: frames, with the codes that were found for them.

    Args:
        world: With both stages.
        frames: That were searched.
        code: Found for all of them.
        seed: Of all draws.

    Raises:
        TrainingError: Nothing explains any frame.
    """
    found = code[CONFIDENCE][:, 0, 0] > 0
    if not found.any():
        raise TrainingError(
            f"--method hypotheses: no pose explains any of {len(frames):,} frames, so there is nothing to learn from; "
            "use --method sleep"
        )
    images = torch.cat([frames[row : row + 1] for row in found.nonzero()[:, 0].tolist()])
    known = index(code, found)
    return [FoundPositions(world, images, known, seed), FoundCrops(PseudoLabels(world, images, known), seed)]


class FoundPositions(ImageSource):
    """Whole frames, turned and zoomed, for the localisation stage."""

    def __init__(
        self, world: TwoStageWorld, frames: UInt8[Tensor, "num 3 height width"], code: SceneCode, seed: int
    ) -> None:
        """Hold the frames at half their size.

        Args:
            world: With both stages.
            frames: Of its camera.
            code: Found for them.
            seed: Of all draws.
        """
        camera = world.camera
        assert camera.matrix is not None
        self._size = camera.width // _HALVED, camera.height // _HALVED
        self._matrix = scale_matrix(camera.matrix, (camera.width, camera.height), self._size)
        halved = [F.avg_pool2d(chunk.float(), _HALVED).round().byte() for chunk in frames.split(_BATCH)]
        self._frames, self._seed = torch.cat(halved), seed
        self._position_m = code[TRANSLATION].double().numpy()

    def batch(self, step: int, size: int) -> Batch:
        """Random frames as the localisation stage sees them."""
        random = np.random.default_rng((self._seed, step))
        seen = [self._turned(number, random) for number in random.integers(len(self._frames), size=size)]
        images = F.avg_pool2d(torch.stack([image for image, _ in seen]), LOCALISATION_STRIDE // _HALVED)
        position_m = np.stack([position_m for _, position_m in seen])
        return Batch(images, code={TRANSLATION: torch.from_numpy(position_m).float()})

    def _turned(self, number: int, random: np.random.Generator) -> tuple[Tensor, np.ndarray]:
        """A frame, and where it shows the object; as it is where a turned camera would not see the object."""
        frame, position_m = self._frames[number], self._position_m[number]
        image, turned_m = seen_by(random_camera(random), frame, self._matrix, position_m)
        if in_view(turned_m, self._matrix, *self._size).all():
            return image, turned_m
        return frame.float() / 255, position_m


class FoundCrops(ImageSource):
    """Crops around found poses, as the errors of the localisation stage leave them, and crops without the object."""

    def __init__(self, labels: PseudoLabels, seed: int) -> None:
        """Draw nothing yet."""
        self._labels, self._seed = labels, seed

    def batch(self, step: int, size: int) -> Batch:
        """Random crops."""
        code, images = self._labels.draw(size, (self._seed, step), LARGEST_ROLL_DEG)
        absent = round(ABSENT_FRACTION * size)
        images[:absent] = self._labels.elsewhere(absent, (self._seed, step, 1))
        code[CONFIDENCE][:absent] = 0
        return Batch(images, code=code, given={name: code[name] for name in self._labels.given})
