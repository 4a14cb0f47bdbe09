"""Worlds of one known object in six degrees of freedom, over backgrounds of any kind."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.camera import Intrinsics, scale_matrix
from curio_train.data.augmentation import KNOWN_SCENE, UNKNOWN_SCENE, AugmentationStrength, augment
from curio_train.data.backgrounds import Backgrounds
from curio_train.geometry import matrix_from_rotation_6d, rotation_6d_from_matrix
from curio_train.meshes.inset import inset
from curio_train.meshes.meshes import Mesh
from curio_train.rendering.renderer import Renderer
from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION, Field, Layout, SceneCode
from curio_train.worlds.base import SPLITS, Camera, ObjectKind, Split, World, jitter_seed
from curio_train.worlds.generated.fields import COLOR_FIELD, CONFIDENCE_FIELD
from curio_train.worlds.rendered_stream import APPEARANCE, RenderedStream
from curio_train.worlds.single_object.base_colors import MIDDLE_GREY, BaseColorPrior, any_base_color
from curio_train.worlds.single_object.viewpoints import (
    AMBIENT,
    ANY_EXPOSURE,
    MAX_LIGHT,
    MILD_EXPOSURE,
    MIN_LIGHT,
    MIN_LIGHT_OF_KNOWN_SCENE,
    Exposure,
    allocentric_to_egocentric,
    random_exposures,
    random_lights,
    random_positions,
    upper_hemisphere_rotations,
)

RotationPrior = Callable[[int, np.random.Generator], Float[Tensor, "count 3 3"]]
"""Draws rotations cam_from_obj of objects on the optical axis."""

EXPOSURE = "exposure"
"""Key beside the code of an object with colours of its own: factors on them, [batch, 1, 3], never predicted. Cameras
see a part on a desk darker, and of another tint, than its mesh's colours."""


@dataclass(frozen=True, eq=False)
class Object:
    """The object of a world, and the scenes that it occurs in."""

    kind: ObjectKind
    """Name, size and symmetries."""
    mesh: Mesh
    """Its shape, metres, with the kind's middle at the origin."""
    camera: Intrinsics
    """The camera that takes the frames."""
    near_m: float
    """Smallest distance along the optical axis."""
    far_m: float
    """Largest distance along the optical axis."""
    backgrounds: Callable[[Path], Backgrounds]
    """Renders its backgrounds, or finds them in a cache folder."""
    rotations: RotationPrior = field(default=upper_hemisphere_rotations)
    """Viewpoints that it is seen from."""
    unpainted: bool = False
    """The mesh has no colours: it has another base colour in each image, which is part of the scene code."""
    base_colors: BaseColorPrior = field(default=any_base_color)
    """Prior of these base colours."""
    typical_color: tuple[float, float, float] = MIDDLE_GREY
    """The most typical of these base colours, sRGB, which templates of an unpainted object show."""
    known_scene: bool = False
    """Whether its background, and the light there, are known."""
    scan_excess_m: float = 0.0
    """How far the mesh's surface lies outside the real one: depth fusion makes scanned objects too thick."""

    @property
    def seen_from_any_side(self) -> bool:
        """Whether it may be seen from below and rolled in any way."""
        return self.rotations is not upper_hemisphere_rotations

    @property
    def mesh_of_file(self) -> Mesh:
        """Its shape with the origin of its file, which the poses of exported models are of."""
        return self.mesh.moved(np.array(self.kind.center_m))

    def without_scan_excess(self) -> "Object":
        """The object as thick as the real one."""
        return replace(self, mesh=inset(self.mesh, self.scan_excess_m), scan_excess_m=0.0)


class SingleObjectWorld(World):
    """One object anywhere in the frame of a pinhole camera, rendered without end."""

    object: Object
    """The object."""
    given: tuple[str, ...] = ()
    """Entries of its codes that are known of every image and never predicted."""
    num_instances: int = 1
    """Copies of the object in each image."""
    random_appearance: bool = False
    """Whether training images show the object with random surface properties, unless the scene is known."""

    def __init__(self, name: str, object_: Object, camera: Camera, layout: Layout) -> None:
        """Hold the object.

        Args:
            name: As on the command line; of a stage, as in the names of its losses.
            object_: The object.
            camera: The camera of its images, with a matrix.
            layout: Of its scene code.
        """
        self.name, self.object, self.camera, self.layout = name, object_, camera, layout
        self.objects = (object_.kind,)

    @property
    def model_name(self) -> str:
        """The object's own name."""
        return self.object.kind.name

    def sample(self, count: int, seed: tuple[int, ...]) -> dict[str, Tensor]:
        """Poses anywhere in the frame, light from the camera's side."""
        random = np.random.default_rng(seed)
        translation_m = random_positions(position_field(self.object), count, random)
        rotation = allocentric_to_egocentric(translation_m, self.object.rotations(count, random))
        code = pose_code(translation_m, rotation, self.sample_lights(count, random))
        code |= self.sample_colors(count, random)
        return code | {CONFIDENCE: torch.ones(count, 1, 1)} if CONFIDENCE in self.layout else code

    def render(self, code: SceneCode, backgrounds: Tensor | None = None) -> Tensor:
        """The object over ``backgrounds``, or over black."""
        assert self.camera.matrix is not None
        return self._render(code, code[TRANSLATION].float(), self.camera.matrix, backgrounds)

    def augment(self, images: Tensor, seed: tuple[int, ...]) -> Tensor:
        """Renderings as real cameras and scenes change them, see :func:`~curio_train.data.augmentation.augment`."""
        return augment(images, np.random.default_rng(seed), self.augmentation)

    @property
    def augmentation(self) -> AugmentationStrength:
        """Strength of the augmentation of its images."""
        return KNOWN_SCENE if self.object.known_scene else UNKNOWN_SCENE

    @property
    def exposure(self) -> Exposure:
        """Range of the exposures of an object with its own colours."""
        return MILD_EXPOSURE if self.object.known_scene else ANY_EXPOSURE

    def sample_lights(self, count: int, random: np.random.Generator) -> Float[Tensor, "count 3"]:
        """Random lights; in a known scene none is weaker than a lamp or a window."""
        return random_lights(count, random, MIN_LIGHT_OF_KNOWN_SCENE if self.object.known_scene else MIN_LIGHT)

    def sample_colors(self, count: int, random: np.random.Generator) -> dict[str, Tensor]:
        """The colour entry of codes, [count, 1, 3]: sRGB base colours of an unpainted object, else exposures."""
        if self.object.unpainted:
            return {COLOR: self.object.base_colors(count, random)}
        return {EXPOSURE: random_exposures(count, random, self.exposure)}

    def source(self, split: Split, seed: int, *, with_code: bool, cache: Path) -> RenderedStream:
        """An endless stream of renderings; the splits differ in poses and in backgrounds."""
        training = split == "train"
        backgrounds = self.backgrounds(cache).split(training)
        return RenderedStream(
            self,
            backgrounds,
            (SPLITS.index(split), seed),
            with_code=with_code,
            given=self.given,
            random_appearance=training and self.random_appearance and not self.object.known_scene,
        )

    def backgrounds(self, cache: Path) -> Backgrounds:
        """The backgrounds of its images."""
        return self.object.backgrounds(cache)

    @cached_property
    def _renderer(self) -> Renderer:
        kinds = [0] * self.num_instances
        return Renderer([self.object.mesh], kinds, self.camera.width, self.camera.height, ambient=AMBIENT)

    def _render(self, code: SceneCode, translation_m: Tensor, matrix: np.ndarray, backgrounds: Tensor | None) -> Tensor:
        size = (len(translation_m), 3, self.camera.height, self.camera.width)
        return self._renderer(
            matrix_from_rotation_6d(code[ROTATION_6D].float()),
            translation_m,
            camera_matrix=matrix,
            backgrounds=translation_m.new_zeros(size) if backgrounds is None else backgrounds,
            light=code[LIGHT].float(),
            color=code[COLOR].float() if COLOR in code else code.get(EXPOSURE),
            confidence=code[CONFIDENCE][..., 0].float() if CONFIDENCE in code else None,
            appearance=code.get(APPEARANCE),
            seed=jitter_seed(code),
        )


def pose_code(
    translation_m: Float[Tensor, "count 3"], rotation: Float[Tensor, "count 3 3"], light: Float[Tensor, "count 3"]
) -> dict[str, Tensor]:
    """The code of scenes with one object."""
    return {
        TRANSLATION: translation_m[:, None],
        ROTATION_6D: rotation_6d_from_matrix(rotation)[:, None],
        LIGHT: light,
    }


def position_field(object_: Object) -> Field:
    """Positions of the object's middle: anywhere in the frame, between the smallest and the largest distance."""
    camera = object_.camera
    center, focal = camera.matrix[[0, 1], 2], camera.matrix[[0, 1], [0, 1]]
    first, last = ((np.array(corner) - center) / focal for corner in ((0, 0), (camera.width - 1, camera.height - 1)))
    return Field(
        TRANSLATION,
        3,
        unit="m",
        frame="camera",
        activation="perspective",
        lower=(*first.tolist(), object_.near_m),
        upper=(*last.tolist(), object_.far_m),
    )


def pose_layout(position: Field, *, confidence: bool, color: bool = False, num_slots: int = 1) -> Layout:
    """The paper's R¹² of one object: position 3, rotation 6, light 3; confidence and colour are not the paper's."""
    rotation = Field(ROTATION_6D, 6, frame="camera", lower=(-1.0,) * 6, upper=(1.0,) * 6)
    bounds = (-MAX_LIGHT,) * 3, (MAX_LIGHT,) * 3
    light = Field(LIGHT, 3, per_object=False, frame="camera", lower=bounds[0], upper=bounds[1])
    return Layout((position, rotation, *[CONFIDENCE_FIELD] * confidence, *[COLOR_FIELD] * color, light), num_slots)


def resized(camera: Intrinsics, width: int, height: int) -> Camera:
    """A camera of this view with another number of pixels."""
    return Camera(width, height, scale_matrix(camera.matrix, (camera.width, camera.height), (width, height)))


def squeezed(camera: Intrinsics, side: int) -> Camera:
    """The whole frame in a square image: one scale for both axes, the frame in the middle."""
    longer = max(camera.width, camera.height)
    square = np.array(camera.matrix, dtype=np.float64)
    square[0, 2] += (longer - camera.width) / 2
    square[1, 2] += (longer - camera.height) / 2
    return Camera(side, side, scale_matrix(square, (longer, longer), (side, side)))
