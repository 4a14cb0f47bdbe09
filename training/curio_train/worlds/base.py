"""What every world is: a scene code, a distribution of scenes, and a differentiable renderer."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from curio_train.config import DecoderKind, NetworkConfig
from curio_train.data.bop import ModelInfo
from curio_train.errors import UsageError
from curio_train.geometry import matrix_from_rotation_6d, rotation_6d_from_matrix
from curio_train.metrics.assignment import nearest_alike, scene_error
from curio_train.networks.base import StageNetwork
from curio_train.networks.paper.network import PoseNetwork
from curio_train.scene_code import CONFIDENCE, PRESENCE, ROTATION_6D, TRANSLATION, Field, Layout, SceneCode

Split = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = ("train", "validation", "test")


@dataclass(frozen=True)
class ObjectKind:
    """The properties of a kind of object that an exported model holds."""

    name: str
    """Name that people and clients read."""
    slots: tuple[int, ...]
    """Rows of the per-object fields that belong to this kind."""
    diameter_m: float
    """Largest distance of two points of the object (image widths in 2D worlds)."""
    box_corners_m: np.ndarray
    """[8, 3], object frame."""
    mesh_sha256: str = ""
    """SHA-256 of the mesh file, or empty."""
    symmetries: Sequence[np.ndarray] = ()
    """Discrete ones, each [4, 4], without the identity."""
    symmetry_axes: Sequence[tuple[np.ndarray, np.ndarray]] = ()
    """Continuous ones, each (unit axis [3], point on it in metres [3])."""
    center_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The object's middle, object frame. Scene codes have its position; outputs have the origin's."""
    hull_m: np.ndarray | None = None
    """Points of its convex hull, [n, 3], object frame; None for kinds that always stand the same way, or are flat."""
    attribution: str = ""
    """Source and licence of the mesh if it is not ours; the model's card quotes it."""

    @property
    def info(self) -> ModelInfo:
        """Diameter and symmetries, for pose metrics."""
        return ModelInfo(self.diameter_m, tuple(self.symmetries), tuple(self.symmetry_axes))


@dataclass(frozen=True)
class Batch:
    """Images for one step."""

    images: Tensor
    """[batch, 3, height, width], float sRGB in [0, 1]."""
    backgrounds: Tensor | None = None
    """Re-renderings are composited over these, same shape; None: over the world's own background."""
    code: SceneCode | None = None
    """The true scene code, for supervision and scoring alone; None if labels are not used."""
    given: SceneCode = field(default_factory=dict)
    """Values known of each image beside its code, such as the assumed depth of a crop."""


@dataclass(frozen=True, eq=False)
class PhotographSet:
    """Photographs by one camera that stood still."""

    photographs: Tensor
    """uint8 [num, 3, height, width], in the size of the world's camera."""
    background_image: Tensor
    """uint8 [3, height, width]: the empty scene."""
    names: Sequence[str] = ()
    """Names of the photographs' files; empty where they are none."""


class ImageSource(ABC):
    """Unlabelled (or, if asked for, labelled) training images.

    Batches are a pure function of the step, so a resumed run sees what an uninterrupted one would have seen.
    """

    @abstractmethod
    def batch(self, step: int, size: int) -> Batch:
        """The images of one step."""

    def backgrounds(self, step: int, size: int) -> Tensor | None:
        """The backgrounds of one step's batch alone, for rendering other scene codes over them."""
        return self.batch(step, size).backgrounds

    def subset(self, fraction: float) -> "ImageSource":
        """The first images of a finite set.

        Raises:
            UsageError: The images are drawn without end, so there is no fraction of them.
        """
        raise UsageError(
            f"this world draws images without end, so --labels {fraction} means nothing; expected --labels 1"
        )


@dataclass(frozen=True)
class Camera:
    """The canonical pinhole camera."""

    width: int
    """Width of an image, pixels."""
    height: int
    """Height of an image, pixels."""
    matrix: np.ndarray | None = field(default=None)
    """K* [3, 3] in pixels (pixel centres at integers); None in 2D worlds."""
    is_default: bool = False
    """An exported model assumes this camera, scaled to the frame, for frames without K. True in worlds whose images are
    all renderings."""


class CameraFrameOutputs:
    """Converts scene codes to the outputs of an exported model and back; here codes are in the camera frame already."""

    def __init__(self, layout: Layout, centers_m: Float[Tensor, "slots 3"] | None = None) -> None:
        """Hold the layout.

        Args:
            layout: Of the scene code.
            centers_m: The point of each slot's object whose position scene codes have, object frame; None: the origin.
        """
        self._layout, self._centers_m = layout, centers_m

    @property
    def fields(self) -> tuple[Field, ...]:
        """The outputs in the model's specification; it adds the 3x3 ``rotation`` itself."""
        return self._layout.fields

    def of_slots(self, slots: Tensor) -> "CameraFrameOutputs":
        """The conversion for these slots alone."""
        return self if self._centers_m is None else CameraFrameOutputs(self._layout, self._centers_m[slots])

    def from_code(self, code: SceneCode) -> dict[str, Tensor]:
        """The outputs for scene codes, all in the camera frame.

        Returns:
            The fields; beside ``rotation_6d`` also ``rotation`` [batch, slots, 3, 3], and ``confidence`` and
            ``presence``, where there is one, without their last dimension, [batch, slots].
        """
        outputs = {field.name: code[field.name] for field in self._layout.fields}
        if ROTATION_6D in code:
            outputs["rotation"] = matrix_from_rotation_6d(code[ROTATION_6D])
            outputs[ROTATION_6D] = rotation_6d_from_matrix(outputs["rotation"])
        if self._centers_m is not None:
            outputs[TRANSLATION] = outputs[TRANSLATION] - self._from_origin(outputs)
        return outputs | {name: code[name].squeeze(-1) for name in (CONFIDENCE, PRESENCE) if name in code}

    def to_code(self, outputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The scene codes that :meth:`from_code` made these outputs of."""
        code = {field.name: outputs[field.name] for field in self._layout.fields}
        code |= {name: outputs[name].unsqueeze(-1) for name in (CONFIDENCE, PRESENCE) if name in outputs}
        if self._centers_m is not None:
            code[TRANSLATION] = code[TRANSLATION] + self._from_origin(outputs)
        return code

    def at_middles(self, outputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The outputs with the positions of the objects' middles, which do not hang on how far away an origin is."""
        if self._centers_m is None:
            return dict(outputs)
        return {**outputs, TRANSLATION: outputs[TRANSLATION] + self._from_origin(outputs)}

    def _from_origin(self, outputs: Mapping[str, Tensor]) -> Float[Tensor, "batch slots 3"]:
        """From the objects' origins to their middles, camera frame."""
        assert self._centers_m is not None
        return (outputs["rotation"] @ self._centers_m.to(outputs[TRANSLATION])[..., None])[..., 0]


class Explainer(Protocol):
    """Finds the scenes of images by rendering many hypotheses."""

    def explain(self, images: Tensor) -> SceneCode:
        """The codes that were found for images, uint8 [batch, 3, height, width]; none of them is a label.

        Objects that were not found have a confidence of 0.
        """


class World(ABC):
    """A family of scenes that can be described, drawn at random, and rendered."""

    name: str
    """The world's name on the command line; of a stage, the name that its losses have."""
    layout: Layout
    """Layout of its scene code."""
    camera: Camera
    """The camera of its images."""
    objects: tuple[ObjectKind, ...]
    """The kinds of objects."""
    decoders: ClassVar[frozenset[DecoderKind]] = frozenset({"whole"})
    """Decoders that can predict its scene codes (``NetworkConfig.reading``)."""
    colors_interchangeable: bool = False
    """Whether a scene with exchanged colour channels is as likely, and looks like its image with exchanged channels."""
    comparison_blur_px: int = 1
    """Image loss and critic compare images behind a Gaussian filter of this side; 1 compares them as they are."""
    yaw_folds: Tensor | None = None
    """[slots] int: by what the angle of each slot's object is multiplied to give the yaw in scene codes; None: by 1."""

    @property
    def model_name(self) -> str:
        """Name of exported models unless the user gives one."""
        return self.name

    @property
    def outputs(self) -> CameraFrameOutputs:
        """Conversion between scene codes and the outputs of exported models."""
        centers_m = np.zeros((self.layout.num_slots, 3), np.float32)
        for kind in self.objects:
            centers_m[list(kind.slots)] = kind.center_m
        return CameraFrameOutputs(self.layout, torch.from_numpy(centers_m) if centers_m.any() else None)

    @property
    def slot_infos(self) -> Sequence[ModelInfo]:
        """Symmetries of each slot's object, in the frame that rotations in scene codes are from."""
        return [kind.info for kind in self.objects for _ in kind.slots]

    def network(self, config: NetworkConfig) -> StageNetwork:
        """A new network that predicts scene codes of this world's images.

        Raises:
            UsageError: The sizes do not fit the images.
        """
        return PoseNetwork(self.layout, self.camera.width, config)

    def code_loss(self, predicted: SceneCode, true: SceneCode) -> Float[Tensor, ""]:
        """The loss of sleep and of full supervision: the paper's Eq. 1, mean over the batch.

        Codes are scored by the same number: of rotations that look alike, the one nearest to the prediction is the true
        one. The assignment of slots has no gradient.
        """
        groups = tuple(kind.slots for kind in self.objects)
        true = nearest_alike(self.layout, predicted, true, self.slot_infos, groups)
        return scene_error(self.layout, predicted, true, groups).mean()

    @abstractmethod
    def sample(self, count: int, seed: tuple[int, ...]) -> dict[str, Tensor]:
        """Draw ``count`` scene codes from the world's own distribution; the same seed gives the same codes."""

    @abstractmethod
    def render(self, code: SceneCode, backgrounds: Tensor | None = None) -> Tensor:
        """Images [batch, 3, height, width] in sRGB of a batch of codes, differentiable in every field."""

    @abstractmethod
    def source(self, split: Split, seed: int, *, with_code: bool, cache: Path) -> ImageSource:
        """Images of a split. Without ``with_code`` no label file is opened and ``Batch.code`` is None."""

    def augment(self, images: Tensor, seed: tuple[int, ...]) -> Tensor:
        """Renderings [batch, 3, height, width] with the known differences to the data applied; here there are none."""
        return images

    def comparable(self, code: SceneCode, images: Tensor) -> SceneCode:
        """The code as it has to be rendered for the comparison with images [batch, 3, height, width].

        Here it is the code itself; what others add has no gradient.
        """
        return code

    def novel_view(self, code: SceneCode) -> Tensor:
        """Images [batch, 3, height, width] for the paper's image error, from a second camera if the world has one."""
        return self.render(code)

    def explainer(self) -> Explainer:
        """A search for the scenes of images.

        Raises:
            UsageError: Scenes of this world cannot be found so.
        """
        raise UsageError(
            f"--method hypotheses: {self.name} has no hypotheses here; expected chairs, multi, light, or linemod with "
            "one class in two stages"
        )


@runtime_checkable
class StagedWorld(Protocol):
    """A world whose network works in stages, each trained on images and codes of its own."""

    @property
    def stages(self) -> tuple[World, ...]:
        """The stages in the order in which the network runs them."""

    @property
    def stage_schedule(self) -> tuple[int, ...]:
        """Number of the stage that each training step trains, repeated without end."""

    def assemble(self, networks: Sequence[StageNetwork]) -> nn.Module:
        """The networks of all stages as one, from image to scene code; this is what is exported."""

    def calibrate_confidence(self, network: nn.Module, cache: Path) -> None:
        """Calibrate the assembled network's confidence in place, after training."""


def stages_of(world: World) -> tuple[World, ...]:
    """The stages that are trained: the world itself unless it is a :class:`StagedWorld`."""
    return world.stages if isinstance(world, StagedWorld) else (world,)


def jitter_seed(code: SceneCode) -> int:
    """A seed for sampling jitter that is a function of the code: it differs between steps, and resumed runs repeat it.

    Args:
        code: With positions [batch, slots, 3].
    """
    bits = code[TRANSLATION].detach().cpu().float().contiguous().view(torch.int32)
    return int(bits.long().sum().item()) & 0x7FFFFFFF
