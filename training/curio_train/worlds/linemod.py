"""LineMOD: one known object in front of clutter, six degrees of freedom and light (paper, section "LineMOD").

The scene code is the paper's R¹²: position 3, rotation 6, light 3. Images are rendered without end over cluttered
backgrounds; poses come from the range that the data set's authors publish (Hinterstoisser et al. 2012: the upper
hemisphere around an object that stands on a table, camera rolled by up to 45°; BOP's LM-O reaches further in depth).

Constants fixed before any training:

* depth 0.5 to 1.5 m; the object's centre anywhere in the frame;
* light from the camera's half space, of strength 0.2 to 1.1 over an ambient radiance of 0.4.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.camera import scale_matrix
from curio_train.data.augmentation import disturb
from curio_train.data.backgrounds import Backgrounds, ClutterBackgrounds, PhotographBackgrounds
from curio_train.data.bop import BopDataset
from curio_train.data.photographs import Photographs
from curio_train.geometry import matrix_from_rotation_6d, rotation_6d_from_matrix, rotation_between
from curio_train.rendering.renderer import Renderer
from curio_train.scene_code import LIGHT, ROTATION_6D, TRANSLATION, Field, Layout, SceneCode
from curio_train.worlds.base import Batch, Camera, ImageSource, ObjectKind, Split, World, jitter_seed
from curio_train.worlds.options import LinemodOptions

SIDE_PX = 128
NEAR_M, FAR_M = 0.5, 1.5
LARGEST_ROLL_DEG = 45.0
AMBIENT = 0.4
WEAKEST_LIGHT, STRONGEST_LIGHT = 0.2, 1.1
_SPLITS: tuple[Split, ...] = ("train", "validation", "test")


class Linemod(World):
    """One LineMOD object, seen by a camera whose whole frame is squeezed into 128x128 pixels.

    Attributes:
        mesh: The object, metres.
    """

    name = "linemod"
    # Where the object is comes first: until it is found, what its light and rotation would teach is noise.
    sleep_weights: Mapping[str, float] = {TRANSLATION: 4.0, ROTATION_6D: 0.4, LIGHT: 0.2}

    def __init__(self, options: LinemodOptions) -> None:
        """Read mesh, camera and symmetries.

        Raises:
            UsageError: Unknown class.
            DataError: The folder is not a BOP data set, or lacks the class.
            MeshError: The mesh is broken.
        """
        dataset = BopDataset(options.data)
        self._options = options
        self.mesh = dataset.mesh(options.class_name)
        info = dataset.model_info(options.class_name)
        self.objects = (
            ObjectKind(
                options.class_name,
                (0,),
                info.diameter_m,
                self.mesh.box_corners_m,
                self.mesh.sha256,
                info.symmetries,
                info.symmetry_axes,
            ),
        )
        camera = dataset.camera
        matrix = _squeezed(camera.matrix, camera.width, camera.height)
        self.camera = Camera(SIDE_PX, SIDE_PX, matrix)
        self._matrix = matrix
        center = camera.matrix[[0, 1], 2]
        focal = camera.matrix[[0, 1], [0, 1]]
        first, last = (
            (np.array(corner) - center) / focal for corner in ((0, 0), (camera.width - 1, camera.height - 1))
        )
        self.layout = Layout(
            (
                Field(
                    TRANSLATION,
                    3,
                    unit="m",
                    frame="camera",
                    activation="perspective",
                    lower=(*first.tolist(), NEAR_M),
                    upper=(*last.tolist(), FAR_M),
                ),
                Field(ROTATION_6D, 6, frame="camera", lower=(-1.0,) * 6, upper=(1.0,) * 6),
                Field(
                    LIGHT,
                    3,
                    per_object=False,
                    frame="camera",
                    lower=(-STRONGEST_LIGHT,) * 3,
                    upper=(STRONGEST_LIGHT,) * 3,
                ),
            )
        )
        self._renderer = Renderer([self.mesh], [0], SIDE_PX, SIDE_PX, ambient=AMBIENT)

    @property
    def model_name(self) -> str:
        """The class's own name."""
        return self._options.class_name

    def sample(self, count: int, seed: tuple[int, ...]) -> dict[str, Tensor]:
        """Poses from the published range, light from the camera's side."""
        random = np.random.default_rng(seed)
        field = self.layout[TRANSLATION]
        position = random.uniform(field.lower, field.upper, (count, 3))
        position[:, :2] *= position[:, 2:]
        translation = torch.from_numpy(position).float()
        rotation = _turned_towards(translation, _views(count, random))
        return {
            TRANSLATION: translation[:, None],
            ROTATION_6D: rotation_6d_from_matrix(rotation)[:, None],
            LIGHT: torch.from_numpy(_lights(count, random)).float(),
        }

    def render(self, code: SceneCode, backgrounds: Tensor | None = None) -> Tensor:
        """The object over ``backgrounds``, or over black."""
        count = len(code[TRANSLATION])
        behind = torch.zeros(count, 3, SIDE_PX, SIDE_PX) if backgrounds is None else backgrounds
        return self._renderer(
            matrix_from_rotation_6d(code[ROTATION_6D].float()),
            code[TRANSLATION].float(),
            camera_matrix=self._matrix,
            backgrounds=behind,
            light=code[LIGHT].float(),
            seed=jitter_seed(code),
        )

    def disturb(self, images: Tensor, seed: tuple[int, ...]) -> Tensor:
        """What real cameras and scenes do to a picture, see :func:`~curio_train.data.augmentation.disturb`."""
        return disturb(images, np.random.default_rng(seed))

    def source(self, split: Split, seed: int, *, with_code: bool, cache: Path) -> "RenderedStream":
        """An endless stream of renderings; the splits differ in poses and in backgrounds."""
        folder = self._options.backgrounds
        backgrounds = PhotographBackgrounds(Photographs(folder)) if folder else ClutterBackgrounds.cached(cache)
        return RenderedStream(self, backgrounds.split(split == "train"), (_SPLITS.index(split), seed), with_code)


class RenderedStream(ImageSource):
    """Images of a world over random backgrounds, rendered as they are asked for and never stored."""

    def __init__(self, world: Linemod, backgrounds: Backgrounds, seed: tuple[int, ...], with_code: bool) -> None:
        self._world, self._backgrounds, self._seed, self._with_code = world, backgrounds, seed, with_code

    @torch.no_grad()
    def batch(self, step: int, size: int) -> Batch:
        """The images of one step, a function of seed and step alone."""
        seed = (*self._seed, step)
        code = self._world.sample(size, seed)
        backgrounds = self._backgrounds.draw(size, SIDE_PX, SIDE_PX, seed)
        images = self._world.render(code, backgrounds)
        return Batch(images, backgrounds, code if self._with_code else None)


def build(options: LinemodOptions) -> Linemod:
    """The world of one LineMOD class."""
    return Linemod(options)


def _squeezed(matrix: np.ndarray, width: int, height: int) -> np.ndarray:
    """K of the whole frame in a square image: one scale for both axes, the frame in the middle."""
    longer = max(width, height)
    square = np.array(matrix, dtype=np.float64)
    square[0, 2] += (longer - width) / 2
    square[1, 2] += (longer - height) / 2
    return scale_matrix(square, (longer, longer), (SIDE_PX, SIDE_PX))


def _views(count: int, random: np.random.Generator) -> Float[Tensor, "count 3 3"]:
    """Rotations cam_from_obj of cameras on the upper hemisphere (object z up) that look at the object, rolled."""
    azimuth = random.uniform(0, 2 * np.pi, count)
    height = random.uniform(0, 1, count)  # of the camera on the unit sphere: uniform there is uniform in area
    level = np.sqrt(1 - height**2)
    forward = -np.stack([level * np.cos(azimuth), level * np.sin(azimuth), height], axis=1)
    right = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(count)], axis=1)
    down = np.cross(forward, right)
    roll = np.radians(random.uniform(-LARGEST_ROLL_DEG, LARGEST_ROLL_DEG, count))[:, None]
    rows = [np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right, forward]
    return torch.from_numpy(np.stack(rows, axis=1)).float()


def _turned_towards(translation: Float[Tensor, "count 3"], rotation: Float[Tensor, "count 3 3"]) -> Tensor:
    """Rotations of objects seen along the optical axis, carried to where they are in the frame."""
    axis = translation.new_tensor([0.0, 0.0, 1.0]).expand_as(translation)
    return rotation_between(axis, translation) @ rotation


def _lights(count: int, random: np.random.Generator) -> np.ndarray:
    direction = random.normal(size=(count, 3))
    direction[:, 2] = -np.abs(direction[:, 2])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * random.uniform(WEAKEST_LIGHT, STRONGEST_LIGHT, (count, 1))
