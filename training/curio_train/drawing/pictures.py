"""Pictures of scenes for people: the training renderer at full resolution, or stock Mitsuba's path tracer."""

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import torch
from curio_serve.imaging.image import MAX_PIXELS
from scipy.spatial.transform import Rotation
from torch import Tensor

from curio_train.camera import scale_matrix
from curio_train.drawing.photograph import photograph_of
from curio_train.drawing.scenes import Placed, Scene
from curio_train.errors import DataError, UsageError
from curio_train.geometry import Pose
from curio_train.meshes.meshes import Mesh
from curio_train.rendering.bounds import project_bounds
from curio_train.rendering.ground import Ground
from curio_train.rendering.path_tracing import path_traced
from curio_train.rendering.renderer import MAX_RAYS, Renderer
from curio_train.rendering.shadows import fallen
from curio_train.rendering.stock import PosedMesh
from curio_train.worlds.generated.mesh_world import MeshWorld

AMBIENT = 0.4
LIGHT = (-0.25, -0.45, -0.5)
"""Light of scenes whose light nobody knows: from behind the camera, above its left shoulder."""


@dataclass(frozen=True, eq=False)
class SceneContext:
    """Meshes, light and ground: everything needed to draw a scene that its code does not hold."""

    meshes: Mapping[str, Mesh]
    """Meshes by the object's name; the one named "" stands for every object without its own."""
    ambient: float = AMBIENT
    """Radiance from everywhere."""
    light: np.ndarray | None = None
    """Camera frame, towards the light [3], where the scene has none."""
    center_m: np.ndarray | None = None
    """Camera frame, what the camera is carried round; None: the middle of the objects."""
    up: tuple[float, ...] = (0.0, -1.0, 0.0)
    """Camera frame, the axis that it is carried round."""
    ground: Ground | None = None
    """Ground that the objects stand on, camera frame, or None."""

    @classmethod
    def of_world(cls, world: MeshWorld) -> "SceneContext":
        """The context of a generated world's scenes."""
        setup = world.setup
        cam_from_world = setup.cam_from_world
        return cls(
            {kind.name: kind.mesh for kind in world.kinds},
            setup.ambient,
            cam_from_world.rotation @ np.array(setup.sun),
            cam_from_world.apply(np.array(setup.center_m)),
            tuple((cam_from_world.rotation @ np.array(setup.up)).tolist()),
            setup.ground(cam_from_world),
        )

    def mesh(self, kind: str) -> Mesh:
        """The mesh of an object.

        Raises:
            DataError: None has its name.
        """
        found = self.meshes.get(kind, self.meshes.get(""))
        if found is None:
            raise DataError(f"no mesh for object {kind!r}, only for {', '.join(self.meshes)}; add --mesh {kind}=FILE")
        return found

    def light_of(self, scene: Scene) -> np.ndarray:
        """Towards the light [3], camera frame: the scene's own, else this context's, else the usual one."""
        light = scene.light if scene.light is not None else self.light
        return np.array(LIGHT) if light is None else light

    def middle(self, item: Placed) -> np.ndarray:
        """Where the middle of an object's box is, camera frame, metres [3]; its origin may be anywhere.

        Raises:
            DataError: As of :meth:`mesh`.
        """
        found: np.ndarray = item.pose.apply(self.mesh(item.kind).box_corners_m).mean(axis=0)
        return found


@dataclass(frozen=True)
class RenderOptions:
    """Settings of a drawing."""

    height: int | None = None
    """Height of the picture, pixels; None: the scene's own."""
    turn_deg: float = 0.0
    """How far the camera is carried round the objects; 90 is the novel view of the paper's image error."""
    over_photograph: bool = False
    """Draw over the photograph that the objects were found in."""
    path_traced: bool = False
    """Whether stock Mitsuba's path tracer draws, with the light that surfaces give each other."""
    samples: int = 64
    """Rays for each pixel."""

    def __post_init__(self) -> None:
        """Refuse what cannot be drawn."""
        if self.samples < 1 or (self.height is not None and self.height < 1):
            raise UsageError(f"found --samples {self.samples} and --height {self.height}, expected at least 1")
        if not math.isfinite(self.turn_deg):
            raise UsageError(f"--turn-deg {self.turn_deg}: expected degrees")
        if self.over_photograph and self.turn_deg:
            raise UsageError("--over-photograph and --turn-deg exclude each other: the photograph shows one side alone")


def picture(
    scene: Scene, around: SceneContext, options: RenderOptions, photograph: np.ndarray | None = None
) -> np.ndarray:
    """Draw a scene: [height, width, 3] uint8 sRGB.

    Args:
        scene: What to draw.
        around: What the scene itself does not say.
        options: How to draw it.
        photograph: [height, width, 3] uint8 sRGB to draw over, in place of the scene's file.

    Raises:
        UsageError: The options' height makes the picture too large.
        DataError: An object without a mesh, a photograph that is missing or of another size, or a scene too large.
        RendererError: No usable libLLVM, or a mesh that cannot be rendered.
    """
    scene, around = _resized(scene, options.height), replace(around, light=around.light_of(scene))
    behind = _fitted(photograph, scene) if photograph is not None else None
    if options.over_photograph:
        behind = _photograph(scene)
    if behind is not None:
        around = replace(around, ground=None)
    scene, around = _carried(scene, around, options.turn_deg)
    draw = _path_traced if options.path_traced else _rendered
    image = draw(scene, around, behind, options.samples)
    return np.asarray((image.clip(0, 1) * 255 + 0.5).astype(np.uint8))


def _resized(scene: Scene, height: int | None) -> Scene:
    if height is None:
        if scene.width * scene.height > MAX_PIXELS:
            raise DataError(f"{scene.name}: found {_too_large(scene.width, scene.height)}; give a --height")
        return scene
    width = max(1, round(scene.width * height / scene.height))
    if width * height > MAX_PIXELS:
        raise UsageError(f"found --height {height} for {_too_large(width, height)}; give a smaller one")
    matrix = scale_matrix(scene.camera_matrix, (scene.width, scene.height), (width, height))
    return replace(scene, width=width, height=height, camera_matrix=matrix)


def _too_large(width: int, height: int) -> str:
    return f"a picture of {width}x{height} pixels, expected at most {MAX_PIXELS:,} pixels"


def _photograph(scene: Scene) -> np.ndarray:
    """The scene's photograph, resized to the scene: [height, width, 3] in [0, 1]."""
    if scene.photograph is None:
        raise DataError(f"{scene.name} is a scene code, which has no photograph; leave out --over-photograph")
    return _fitted(photograph_of(scene), scene)


def _fitted(pixels: np.ndarray, scene: Scene) -> np.ndarray:
    """An image in the scene's size, in [0, 1]."""
    return cv2.resize(pixels, (scene.width, scene.height), interpolation=cv2.INTER_AREA).astype(np.float32) / 255


def _carried(scene: Scene, around: SceneContext, turn_deg: float) -> tuple[Scene, SceneContext]:
    """Everything as the camera sees it that was carried round the middle, still looking at it."""
    middles = [around.middle(item) for item in scene.objects]
    center = np.mean(middles, axis=0) if around.center_m is None and middles else around.center_m
    if turn_deg == 0 or center is None:
        return scene, around
    rotation = Rotation.from_rotvec(-np.radians(turn_deg) * np.array(around.up)).as_matrix()
    orbit = Pose(rotation, center - rotation @ center)
    objects = tuple(replace(item, pose=orbit @ item.pose) for item in scene.objects)
    ground = around.ground
    if ground is not None:
        up = rotation @ ground.up
        # The centre's height over the ground stays; the camera's is that plus its own over the centre.
        ground = replace(ground, up=up, camera_height_m=ground.camera_height_m + float((ground.up - up) @ center))
    assert around.light is not None  # settled before
    return replace(scene, objects=objects), replace(around, light=rotation @ around.light, ground=ground)


def _rendered(scene: Scene, around: SceneContext, behind: np.ndarray | None, samples: int) -> np.ndarray:
    light = torch.tensor(around.light, dtype=torch.float32)[None]
    blank = torch.zeros(1, 1, scene.height, scene.width)
    background = blank.expand(1, 3, -1, -1) if behind is None else torch.from_numpy(behind).permute(2, 0, 1)[None]
    if not scene.objects:
        empty = background if around.ground is None else around.ground.image(around.ambient, light, blank)
        return empty[0].permute(1, 2, 0).numpy()
    kinds = list(dict.fromkeys(item.kind for item in scene.objects))
    meshes, slots = tuple(around.mesh(kind) for kind in kinds), tuple(kinds.index(item.kind) for item in scene.objects)
    shadows = around.ground is not None
    rounds = min(samples, math.ceil(_pixels_traced(scene, around) * samples / MAX_RAYS) or 1)
    each = math.ceil(samples / rounds)
    renderer = _renderer(meshes, slots, scene.width, scene.height, around.ambient, each, shadows)
    seen: dict[str, Any] = {
        "rotation": _stack([item.pose.rotation for item in scene.objects]),
        "translation_m": _stack([item.pose.translation_m for item in scene.objects]),
        "camera_matrix": scene.camera_matrix,
        "light": light,
        "confidence": _stack([item.confidence for item in scene.objects]),
    }
    color = _stack([item.color_srgb for item in scene.objects])

    def one(seed: int) -> Tensor:
        ground = around.ground
        under = background
        if ground is not None:
            under = ground.image(around.ambient, light, renderer.shadows(**seen, ground=ground, seed=seed))
        image: Tensor = renderer(**seen, backgrounds=under, color=color, seed=seed)
        return image[0]

    image = one(0)
    for seed in range(1, rounds):
        image += one(seed)
    return (image / rounds).permute(1, 2, 0).numpy()


def _pixels_traced(scene: Scene, around: SceneContext) -> int:
    """About how many pixels are traced at a time: those of the objects, or those of their shadows."""
    corners_m = np.array([item.pose.apply(around.mesh(item.kind).box_corners_m) for item in scene.objects])
    bodies = [corners_m]
    if around.ground is not None:
        assert around.light is not None  # settled before
        bodies.append(fallen(corners_m, np.tile(around.light, (len(corners_m), 1)), around.ground))
    intrinsics = np.tile(scene.camera_matrix[[0, 1, 0, 1], [0, 1, 2, 2]], (len(corners_m), 1))
    bounds = [project_bounds(body, intrinsics, scene.width, scene.height) for body in bodies]
    return max(int(bound.num_pixels.sum()) for bound in bounds)


@functools.lru_cache(maxsize=4)
def _renderer(
    meshes: tuple[Mesh, ...],
    slots: tuple[int, ...],
    width: int,
    height: int,
    ambient: float,
    samples: int,
    shadows: bool,
) -> Renderer:
    """A renderer, kept for the next scene: scenes of one file mostly show the same objects."""
    return Renderer(meshes, slots, width, height, ambient=ambient, samples_per_pixel=samples, object_shadows=shadows)


def _stack(values: Sequence[object]) -> Tensor:
    return torch.tensor(np.array(values), dtype=torch.float32)[None]


def _path_traced(scene: Scene, around: SceneContext, behind: np.ndarray | None, samples: int) -> np.ndarray:
    assert around.light is not None  # settled before
    objects = [_posed(item, around) for item in scene.objects]
    image = path_traced(
        objects,
        scene.camera_matrix,
        scene.width,
        scene.height,
        ambient=around.ambient,
        light=around.light,
        ground=around.ground,
        samples_per_pixel=samples,
    )
    color, alpha = image[..., :3], image[..., 3:]
    return color * alpha + (0 if behind is None else behind) * (1 - alpha)


def _posed(item: Placed, around: SceneContext) -> PosedMesh:
    rotation, translation_m = item.pose
    return PosedMesh(around.mesh(item.kind), rotation, translation_m, item.color_srgb, item.confidence)
