"""Worlds of one known object in six degrees of freedom, over backgrounds that are anything."""

from collections.abc import Callable
from dataclasses import dataclass, field
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
from curio_train.meshes.meshes import Mesh
from curio_train.rendering.materials import random_appearances
from curio_train.rendering.renderer import Renderer
from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION, Field, Layout, SceneCode
from curio_train.worlds.base import Batch, Camera, ImageSource, ObjectKind, Split, World, jitter_seed
from curio_train.worlds.placement import colors
from curio_train.worlds.single_object.viewpoints import (
    AMBIENT,
    ANY_EXPOSURE,
    MILD_EXPOSURE,
    STRONGEST_LIGHT,
    WEAKEST_KNOWN_LIGHT,
    WEAKEST_LIGHT,
    Exposure,
    exposures,
    lights,
    places,
    turned_towards,
    upper_views,
)

Views = Callable[[int, np.random.Generator], Float[Tensor, "count 3 3"]]
"""Draws rotations cam_from_obj of objects on the optical axis."""

BaseColorPrior = Callable[[int, np.random.Generator], Float[Tensor, "count 1 3"]]
"""Draws sRGB colours of objects."""

EXPOSURE = "exposure"
"""What the colours of an object that has its own are multiplied by, [batch, 1, 3]: drawn beside the code, never
predicted. What a camera sees of a part on a desk is darker, and of another tint, than its mesh's colours."""

FINISH = "finish"
"""What its surface is like beside its colour, drawn beside the code of images that teach and never predicted."""

LEAST_PAINT_VALUE = 0.1
"""Of the colours of an unpainted object, which may be black, white, grey or anything between."""

_FINISH_DRAWS = 1  # of the draws of a step
_SPLITS: tuple[Split, ...] = ("train", "validation", "test")


def any_base_color(count: int, random: np.random.Generator) -> Float[Tensor, "count 1 3"]:
    """Colours of a part of which nothing is known: black, white, grey or anything between."""
    return colors(count, 1, random, 0.0, LEAST_PAINT_VALUE)


@dataclass(frozen=True, eq=False)
class Object:
    """What is looked for, and with what.

    Attributes:
        kind: Name, size and symmetries.
        mesh: Its shape, metres.
        camera: What frames are taken with.
        near_m: Least distance along the optical axis.
        far_m: Largest.
        backgrounds: What it is seen in front of, made or found in a cache folder.
        views: From where it is seen.
        painted: The mesh has no colours: it has another one in each image, which is part of the scene code.
        paints: Which ones.
        known_scene: What is behind the object where it is looked for, and the light there, are known.
    """

    kind: ObjectKind
    mesh: Mesh
    camera: Intrinsics
    near_m: float
    far_m: float
    backgrounds: Callable[[Path], Backgrounds]
    views: Views = field(default=upper_views)
    painted: bool = False
    paints: BaseColorPrior = field(default=any_base_color)
    known_scene: bool = False


class SingleObjectWorld(World):
    """One object before one pinhole camera, anywhere in its frame, rendered without end.

    Attributes:
        object: What is looked for.
        given: Entries of its codes that are known of every image and never predicted.
        num_shown: How many of the object an image shows.
        finished: Images that teach show surfaces of any kind, see finish.py, unless the scene is known.
    """

    given: tuple[str, ...] = ()
    num_shown: int = 1
    finished: bool = False

    def __init__(self, thing: Object, camera: Camera, layout: Layout) -> None:
        self.object, self.camera, self.layout = thing, camera, layout
        self.objects, self.mesh = (thing.kind,), thing.mesh

    @property
    def model_name(self) -> str:
        """The object's own name."""
        return self.object.kind.name

    def sample(self, count: int, seed: tuple[int, ...]) -> dict[str, Tensor]:
        """Poses anywhere in the frame, light from the camera's side."""
        random = np.random.default_rng(seed)
        translation = places(position_field(self.object), count, random)
        rotation = turned_towards(translation, self.object.views(count, random))
        code = scene(translation, rotation, self.lights(count, random))
        code |= self.paint(count, random)
        return code | {CONFIDENCE: torch.ones(count, 1, 1)} if CONFIDENCE in self.layout else code

    def render(self, code: SceneCode, backgrounds: Tensor | None = None) -> Tensor:
        """The object over ``backgrounds``, or over black."""
        assert self.camera.matrix is not None  # these worlds have pinhole cameras
        return self._image(code, code[TRANSLATION].float(), self.camera.matrix, backgrounds)

    def augment(self, images: Tensor, seed: tuple[int, ...]) -> Tensor:
        """What real cameras and scenes do to a picture, see :func:`~curio_train.data.augmentation.augment`."""
        return augment(images, np.random.default_rng(seed), self.augmentation)

    def lights(self, count: int, random: np.random.Generator) -> Tensor:
        """Light of any strength, or, in a known scene, as a place where things are looked at is lit, [count, 3]."""
        return lights(count, random, WEAKEST_KNOWN_LIGHT if self.object.known_scene else WEAKEST_LIGHT)

    @property
    def augmentation(self) -> AugmentationStrength:
        """How much its images are disturbed."""
        return KNOWN_SCENE if self.object.known_scene else UNKNOWN_SCENE

    @property
    def exposure(self) -> Exposure:
        """How much the light on an object that has its own colours differs."""
        return MILD_EXPOSURE if self.object.known_scene else ANY_EXPOSURE

    def paint(self, count: int, random: np.random.Generator) -> dict[str, Tensor]:
        """The entry of codes that says which colour an unpainted object has, [count, 1, 3] sRGB; others' exposure."""
        if self.object.painted:
            return {COLOR: self.object.paints(count, random)}
        return {EXPOSURE: exposures(count, random, self.exposure)}

    def finishes(self, code: SceneCode, seed: tuple[int, ...]) -> dict[str, Tensor]:
        """The entry of a code that says what its surfaces are like, of any kind [batch, slots, FINISH_SIZE]."""
        count, slots = code[TRANSLATION].shape[:2]
        drawn = random_appearances(count * slots, np.random.default_rng((*seed, _FINISH_DRAWS)))
        return {FINISH: drawn.reshape(count, slots, -1)}

    def source(self, split: Split, seed: int, *, with_code: bool, cache: Path) -> "RenderedStream":
        """An endless stream of renderings; the splits differ in poses and in backgrounds."""
        training = split == "train"
        backgrounds = self.backgrounds(cache).split(training)
        return RenderedStream(self, backgrounds, (_SPLITS.index(split), seed), with_code, training)

    def backgrounds(self, cache: Path) -> Backgrounds:
        """What its images show behind the object."""
        return self.object.backgrounds(cache)

    @cached_property
    def _renderer(self) -> Renderer:
        kinds = [0] * self.num_shown
        return Renderer([self.object.mesh], kinds, self.camera.width, self.camera.height, ambient=AMBIENT)

    def _image(self, code: SceneCode, translation_m: Tensor, matrix: np.ndarray, backgrounds: Tensor | None) -> Tensor:
        size = (len(translation_m), 3, self.camera.height, self.camera.width)
        return self._renderer(
            matrix_from_rotation_6d(code[ROTATION_6D].float()),
            translation_m,
            camera_matrix=matrix,
            backgrounds=translation_m.new_zeros(size) if backgrounds is None else backgrounds,
            light=code[LIGHT].float(),
            color=code[COLOR].float() if COLOR in code else code.get(EXPOSURE),
            confidence=code[CONFIDENCE][..., 0].float() if CONFIDENCE in code else None,
            finish=code.get(FINISH),
            seed=jitter_seed(code),
        )


class RenderedStream(ImageSource):
    """Images of a world over random backgrounds, rendered as they are asked for and never stored."""

    def __init__(
        self, world: SingleObjectWorld, backgrounds: Backgrounds, seed: tuple[int, ...], with_code: bool, finished: bool
    ) -> None:
        self._world, self._backgrounds, self._seed, self._with_code = world, backgrounds, seed, with_code
        self._finished = finished and world.finished and not world.object.known_scene

    @torch.no_grad()
    def batch(self, step: int, size: int) -> Batch:
        """The images of one step, a function of seed and step alone."""
        code = self._world.sample(size, (*self._seed, step))
        if self._finished:
            code |= self._world.finishes(code, (*self._seed, step))
        backgrounds = self.backgrounds(step, size)
        images = self._world.render(code, backgrounds)
        given = {name: code[name] for name in self._world.given}
        return Batch(images, backgrounds, code if self._with_code else None, given)

    def backgrounds(self, step: int, size: int) -> Tensor:
        """Without the images, which take longer."""
        camera = self._world.camera
        return self._backgrounds.draw(size, camera.width, camera.height, (*self._seed, step))


def scene(translation: Tensor, rotation: Tensor, light: Tensor) -> dict[str, Tensor]:
    """The code of scenes with one object: [count, 3], [count, 3, 3] and [count, 3]."""
    return {
        TRANSLATION: translation[:, None],
        ROTATION_6D: rotation_6d_from_matrix(rotation)[:, None],
        LIGHT: light,
    }


def position_field(thing: Object) -> Field:
    """Where its centre may be: anywhere in the frame, between the nearest and the farthest distance."""
    camera = thing.camera
    center, focal = camera.matrix[[0, 1], 2], camera.matrix[[0, 1], [0, 1]]
    first, last = ((np.array(corner) - center) / focal for corner in ((0, 0), (camera.width - 1, camera.height - 1)))
    return Field(
        TRANSLATION,
        3,
        unit="m",
        frame="camera",
        activation="perspective",
        lower=(*first.tolist(), thing.near_m),
        upper=(*last.tolist(), thing.far_m),
    )


def pose_layout(position: Field, *, confidence: bool, color: bool = False) -> Layout:
    """The paper's R¹² of one object: position 3, rotation 6, light 3; confidence and colour of one object are ours."""
    rotation = Field(ROTATION_6D, 6, frame="camera", lower=(-1.0,) * 6, upper=(1.0,) * 6)
    bounds = (-STRONGEST_LIGHT,) * 3, (STRONGEST_LIGHT,) * 3
    light = Field(LIGHT, 3, per_object=False, frame="camera", lower=bounds[0], upper=bounds[1])
    sure = Field(CONFIDENCE, 1, activation="sigmoid", lower=(0.0,), upper=(1.0,))
    paint = Field(COLOR, 3, activation="sigmoid", lower=(0.0,) * 3, upper=(1.0,) * 3)
    return Layout((position, rotation, *[sure] * confidence, *[paint] * color, light))


def resized(camera: Intrinsics, width: int, height: int) -> Camera:
    """The same view with other pixels."""
    return Camera(width, height, scale_matrix(camera.matrix, (camera.width, camera.height), (width, height)))


def squeezed(camera: Intrinsics, side: int) -> Camera:
    """The whole frame in a square image: one scale for both axes, the frame in the middle."""
    longer = max(camera.width, camera.height)
    square = np.array(camera.matrix, dtype=np.float64)
    square[0, 2] += (longer - camera.width) / 2
    square[1, 2] += (longer - camera.height) / 2
    return Camera(side, side, scale_matrix(square, (longer, longer), (side, side)))
