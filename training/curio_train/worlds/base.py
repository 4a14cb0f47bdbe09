"""What every world is: a scene code, a distribution of scenes, and a differentiable renderer.

A new world is one file: a subclass of :class:`World` and a line in ``worlds/__init__.py``.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from curio_train.config import DecoderKind, NetworkConfig
from curio_train.data.bop import ModelInfo
from curio_train.errors import UsageError
from curio_train.geometry import matrix_from_rotation_6d, rotation_6d_from_matrix
from curio_train.metrics.assignment import scene_error
from curio_train.networks.base import StageNetwork
from curio_train.networks.paper.network import PoseNetwork
from curio_train.scene_code import CONFIDENCE, ROTATION_6D, TRANSLATION, Field, Layout, SceneCode

if TYPE_CHECKING:
    from curio_train.meshes.meshes import Mesh

Split = Literal["train", "validation", "test"]


@dataclass(frozen=True)
class ObjectKind:
    """What the exported model must know of a kind of object.

    Attributes:
        name: For people and clients.
        slots: Which rows of the per-object fields belong to this kind.
        diameter_m: Largest distance of two points of the object (image widths in 2D worlds).
        box_corners_m: [8, 3], object frame.
        mesh_sha256: Of the mesh file, or empty.
        symmetries: Discrete ones, each [4, 4], the identity left out.
        symmetry_axes: Continuous ones, each (unit axis [3], point on it in metres [3]).
        attribution: Source and licence of the mesh, where it is not ours; goes on the model's card.
    """

    name: str
    slots: tuple[int, ...]
    diameter_m: float
    box_corners_m: np.ndarray
    mesh_sha256: str = ""
    symmetries: Sequence[np.ndarray] = ()
    symmetry_axes: Sequence[tuple[np.ndarray, np.ndarray]] = ()
    attribution: str = ""

    @property
    def info(self) -> ModelInfo:
        """What pose metrics need of it."""
        return ModelInfo(self.diameter_m, tuple(self.symmetries), tuple(self.symmetry_axes))


@dataclass(frozen=True)
class Batch:
    """Images for one step.

    Attributes:
        images: [batch, 3, height, width], float sRGB in [0, 1].
        backgrounds: What the re-rendering is composited over, same shape; None: the world's own background.
        code: The true scene code, for supervision and scoring alone; None where nobody may know it.
        given: What is known of each image beside its code, such as how far away a crop takes its object to be.
    """

    images: Tensor
    backgrounds: Tensor | None = None
    code: SceneCode | None = None
    given: SceneCode = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class View:
    """Photographs from one place.

    Attributes:
        photographs: uint8 [num, 3, height, width], as the world's camera takes them.
        plate: uint8 [3, height, width], the empty scene from there.
    """

    photographs: Tensor
    plate: Tensor


class ImageSource(ABC):
    """Unlabelled (or, when asked for, labelled) training images.

    Batches are a pure function of the step, so a resumed run sees what an uninterrupted one would have seen.
    """

    @abstractmethod
    def batch(self, step: int, size: int) -> Batch:
        """The images of one step."""

    def backgrounds(self, step: int, size: int) -> Tensor | None:
        """The backgrounds of one step's batch alone: all that is taken of it to render codes of one's own making."""
        return self.batch(step, size).backgrounds

    def subset(self, share: float) -> "ImageSource":
        """The first ``share`` of a finite set of images.

        Raises:
            UsageError: The images are drawn without end, so there is no share of them.
        """
        raise UsageError(f"this world draws images without end, so --labels {share} means nothing; expected --labels 1")


@dataclass(frozen=True)
class Camera:
    """The canonical pinhole camera.

    Attributes:
        width: Of an image, pixels.
        height: Of an image, pixels.
        matrix: K* [3, 3] in pixels (pixel centres at integers), None in 2D worlds.
        is_default: A frame that comes without K is taken as this camera's, scaled to the frame: so where all images of
            a world are renderings.
    """

    width: int
    height: int
    matrix: np.ndarray | None = field(default=None)
    is_default: bool = False


class World(ABC):
    """A family of scenes that can be described, drawn at random, and rendered.

    Attributes:
        name: As on the command line.
        layout: Of its scene code.
        camera: What its images are taken with.
        objects: The kinds of object there are.
        mesh: The object's, in worlds of one object, whose poses are scored by its points.
    """

    name: str
    layout: Layout
    camera: Camera
    objects: tuple[ObjectKind, ...]
    mesh: "Mesh | None" = None
    readings: ClassVar[frozenset[DecoderKind]] = frozenset({"whole"})
    """How its images can be read (``NetworkConfig.reading``)."""
    colors_interchangeable: ClassVar[bool] = False
    """Whether scenes with their colours' channels exchanged are as likely, and look like their images so changed."""

    @property
    def stages(self) -> tuple["World", ...]:
        """What is looked at, one after the other, to read one image: worlds with images and codes of their own.

        All but gazes read an image at one look, and are that look themselves.
        """
        return (self,)

    @property
    def turns(self) -> tuple[int, ...]:
        """Which look each training step teaches, over and over."""
        return (0,)

    def network(self, config: NetworkConfig) -> StageNetwork:
        """What reads this world's images at one look.

        Raises:
            UsageError: The sizes do not fit the images.
        """
        return PoseNetwork(self.layout, self.camera.width, config)

    def assemble(self, networks: Sequence[StageNetwork]) -> nn.Module:
        """The networks of all looks as one, from image to scene code: what is exported."""
        (network,) = networks
        return network

    def finish(self, network: nn.Module, cache: Path) -> None:
        """What is left to do for the assembled network when training is done: nothing, in most worlds."""
        return

    def code_loss(self, predicted: SceneCode, true: SceneCode) -> Float[Tensor, ""]:
        """What sleep and full supervision make small: the paper's Eq. 1, mean over the batch.

        It is the very figure that codes are scored by; its assignment of slots has no gradient.
        """
        groups = tuple(kind.slots for kind in self.objects)
        return scene_error(self.layout, predicted, true, groups).mean()

    @property
    def model_name(self) -> str:
        """What a model of this world is called unless its maker names it."""
        return self.name

    @property
    def exported_fields(self) -> tuple[Field, ...]:
        """What the model's specification says of its outputs; the 3x3 ``rotation`` goes without saying."""
        return self.layout.fields

    def exported(self, code: SceneCode) -> dict[str, Tensor]:
        """The physical outputs of an exported model, all in the camera frame.

        ``rotation_6d`` comes out as the columns of the rotation [batch, slots, 3, 3] that stands beside it, confidence
        as [batch, slots]. Worlds with other fields (yaw, light in the world frame) extend this, :attr:`exported_fields`
        and :meth:`from_exported`.
        """
        outputs = {field.name: code[field.name] for field in self.layout.fields}
        if ROTATION_6D in code:
            outputs["rotation"] = matrix_from_rotation_6d(code[ROTATION_6D])
            outputs[ROTATION_6D] = rotation_6d_from_matrix(outputs["rotation"])
        if CONFIDENCE in code:
            outputs[CONFIDENCE] = code[CONFIDENCE].squeeze(-1)
        return outputs

    def from_exported(self, outputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The scene code that :meth:`exported` made these outputs of."""
        code = {field.name: outputs[field.name] for field in self.layout.fields}
        if CONFIDENCE in code:
            code[CONFIDENCE] = code[CONFIDENCE].unsqueeze(-1)
        return code

    @abstractmethod
    def sample(self, count: int, seed: tuple[int, ...]) -> dict[str, Tensor]:
        """Draw ``count`` scene codes from the world's own distribution; the same seed gives the same codes."""

    @abstractmethod
    def render(self, code: SceneCode, backgrounds: Tensor | None = None) -> Tensor:
        """Images [batch, 3, height, width] in sRGB of a batch of codes, differentiable in every field."""

    def augment(self, images: Tensor, seed: tuple[int, ...]) -> Tensor:
        """What lies between renderings and the data, done to renderings that the network learns to read (sleep)."""
        return images

    def compared(self, images: Tensor) -> Tensor:
        """What image loss and critic see of images and of renderings: all of them, in most worlds."""
        return images

    def views(self) -> tuple["View", ...]:
        """Unlabelled photographs to judge by: from the own camera, and of the same scenes from a second one.

        The first are compared with :meth:`render`, the second with :meth:`novel_view`. None, in most worlds.
        """
        return ()

    def photographs(self, count: int) -> Tensor | None:
        """Photographs that nobody labelled, as this world's camera would take them, where there are some.

        At most ``count``, [num, 3, height, width] in [0, 1], to judge by eye what is found in them.

        Raises:
            DataError: One cannot be read, or is not of the camera's size.
        """
        return None

    def plate(self) -> Tensor | None:
        """The empty scene of :meth:`photographs`, [3, height, width] in [0, 1], where it is known.

        Raises:
            DataError: It cannot be read, or is not of the camera's size.
        """
        return None

    def novel_view(self, code: SceneCode) -> Tensor:
        """Scenes as scored by the paper's image error: from 90° round their centre, where a world has such a view."""
        return self.render(code)

    @abstractmethod
    def source(self, split: Split, seed: int, *, with_code: bool, cache: Path) -> ImageSource:
        """Images of a split. Without ``with_code`` no label file is opened and ``Batch.code`` is None."""


def jitter_seed(code: SceneCode) -> int:
    """For jitter that differs from step to step and yet is a function of what is rendered: resumed runs repeat it."""
    bits = code[TRANSLATION].detach().cpu().float().contiguous().view(torch.int32)
    return int(bits.long().sum().item()) & 0x7FFFFFFF
