"""Worlds of generated meshes before one camera: how a scene code becomes an image, and the image sets.

Spheres, Varied, Chairs, Multi and Light differ in their meshes, fields and draws, and in nothing else.
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from curio_train.config import DecoderKind, NetworkConfig
from curio_train.geometry import Pose, direction_from_hemisphere, matrix_from_yaw
from curio_train.meshes.meshes import Mesh
from curio_train.networks.base import StageNetwork
from curio_train.networks.grid import CellGrid
from curio_train.networks.set_detector import HEAT_MAP, SetDetector, dense_loss
from curio_train.rendering.ground import Ground
from curio_train.rendering.renderer import Renderer
from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, TRANSLATION, YAW, Layout, SceneCode
from curio_train.worlds.base import Camera, ObjectKind, Split, World, jitter_seed
from curio_train.worlds.image_sets import StoredImages, stored


@dataclass(frozen=True)
class Kind:
    """A kind of object.

    Attributes:
        name: For people.
        mesh: Its shape; white where the scene code has its colour.
        num_slots: How many slots of the scene code it has; kinds take theirs one after the other.
    """

    name: str
    mesh: Mesh
    num_slots: int


@dataclass(frozen=True, eq=False)
class SceneSetup:
    """What is the same in all scenes of a world.

    Attributes:
        camera: With its matrix.
        cam_from_world: Where it stands.
        center_m: World frame: what the novel camera goes round.
        up: World frame: the axis that it goes round.
        ambient: Radiance from everywhere.
        sun: World frame, towards the light; its length is the strength. Where the code has a light only that counts.
    """

    camera: Camera
    cam_from_world: Pose
    center_m: tuple[float, float, float]
    up: tuple[float, float, float]
    ambient: float
    sun: tuple[float, float, float]

    @property
    def novel(self) -> Pose:
        """cam_from_world of the same camera carried 90° round the scene's centre (design of the paper's Img metric)."""
        turn = Rotation.from_rotvec(np.pi / 2 * np.array(self.up)).as_matrix()
        center = np.array(self.center_m)
        rotation = self.cam_from_world.rotation @ turn.T
        return Pose(
            rotation, self.cam_from_world.translation_m + self.cam_from_world.rotation @ center - rotation @ center
        )


class MeshWorld(World):
    """Objects of known shape under one light, in the world frame of their stage.

    Attributes:
        stage: Camera, light, and where the novel view is taken from.
        kinds: The objects.
        outline_samples: Points on each object's outline, for the gradient.
        object_shadows: Whether objects stand in each other's light.
        on_plane: Whether they lie on the plane y = 0.
    """

    readings: ClassVar[frozenset[DecoderKind]] = frozenset({"whole", "cells"})
    outline_samples = 512
    object_shadows = False
    on_plane = False

    def __init__(self, layout: Layout, kinds: Sequence[Kind], stage: SceneSetup) -> None:
        """Build the renderer.

        Raises:
            RendererError: No usable libLLVM.
        """
        self.layout, self.kinds, self.stage, self.camera = layout, tuple(kinds), stage, stage.camera
        ends = np.cumsum([kind.num_slots for kind in kinds])
        self.objects = tuple(
            ObjectKind(
                kind.name,
                tuple(range(end - kind.num_slots, end)),
                kind.mesh.diameter_m,
                kind.mesh.box_corners_m,
                kind.mesh.sha256,
            )
            for kind, end in zip(kinds, ends.tolist(), strict=True)
        )
        kind_of_slot = [number for number, kind in enumerate(kinds) for _ in range(kind.num_slots)]
        self._renderer = Renderer(
            [kind.mesh for kind in kinds],
            kind_of_slot,
            stage.camera.width,
            stage.camera.height,
            ambient=stage.ambient,
            outline_samples=self.outline_samples,
            object_shadows=self.object_shadows,
        )

    @property
    @abstractmethod
    def constants(self) -> Mapping[str, Any]:
        """What the draws depend on beside layout, meshes and stage; changing one makes new image sets."""

    @property
    def recipe(self) -> dict[str, Any]:
        """All that the images depend on."""
        stage = self.stage
        return {
            "constants": dict(self.constants),
            "fields": [asdict(field) for field in self.layout.fields],
            "kinds": [(kind.name, kind.mesh.sha256, kind.num_slots) for kind in self.kinds],
            "camera": (self.camera.width, self.camera.height, np.asarray(self.camera.matrix).tolist()),
            "cam_from_world": [np.asarray(part).tolist() for part in stage.cam_from_world],
            "light": (stage.ambient, stage.sun),
        }

    def render(self, code: SceneCode, backgrounds: Tensor | None = None) -> Tensor:
        """The scenes from the world's own camera, over ``backgrounds`` or what the world has behind its objects.

        Objects are as transparent as their confidence, where the code has one, whatever the layout says.
        """
        return self._view(code, self.stage.cam_from_world, backgrounds)

    def novel_view(self, code: SceneCode) -> Tensor:
        """The same scenes from 90° round their centre."""
        return self._view(code, self.stage.novel, None)

    def source(self, split: Split, seed: int, *, with_code: bool, cache: Path) -> StoredImages:
        """2,000, 500 and 500 images, the paper's numbers."""
        return stored(self, self.recipe, split, seed, with_code=with_code, cache=cache)

    def network(self, config: NetworkConfig) -> StageNetwork:
        """The paper's, or one that reads cell by cell."""
        if config.reading == "cells":
            return SetDetector(self.layout, self._slots_of_kinds, self._new_grid())
        return super().network(config)

    def code_loss(self, predicted: SceneCode, true: SceneCode) -> Float[Tensor, ""]:
        """Eq. 1, or where cells were read what is wrong with them, mean over the batch."""
        if HEAT_MAP not in predicted:
            return super().code_loss(predicted, true)
        grid = self._grid.to(true[TRANSLATION].device)
        return dense_loss(self.layout, self._slots_of_kinds, grid, predicted, true).mean()

    @property
    def _slots_of_kinds(self) -> tuple[tuple[int, ...], ...]:
        return tuple(kind.slots for kind in self.objects)

    @cached_property
    def _grid(self) -> CellGrid:
        return self._new_grid()

    def _new_grid(self) -> CellGrid:
        assert self.camera.matrix is not None
        size = self.camera.width, self.camera.height
        position = self.layout[TRANSLATION]
        return CellGrid(position, self.camera.matrix, self.stage.cam_from_world, size, on_plane=self.on_plane)

    def light(self, code: SceneCode) -> Float[Tensor, "batch 3"]:
        """Towards the sun, world frame; its length is the strength."""
        sun = code[TRANSLATION].new_tensor(self.stage.sun, dtype=torch.float32)
        if LIGHT in self.layout:
            return direction_from_hemisphere(code[LIGHT].float()) * sun.norm()
        return sun.expand(len(code[TRANSLATION]), 3)

    def ground(self, cam_from_world: Pose) -> Ground | None:
        """What the objects stand on, as a camera there sees it; None: they float before black."""
        return None

    def own_rotation(self, code: SceneCode) -> Float[Tensor, "batch slots 3 3"]:
        """world_from_obj of each object: turned about y by its yaw, where the code has one."""
        if YAW in self.layout:
            return matrix_from_yaw(code[YAW].float())
        place = code[TRANSLATION].float()
        return torch.eye(3).to(place).expand(*place.shape[:2], 3, 3)

    def _view(self, code: SceneCode, cam_from_world: Pose, backgrounds: Tensor | None) -> Tensor:
        place = code[TRANSLATION].float()
        turn, shift = (torch.as_tensor(part).to(place) for part in cam_from_world)
        light = self.light(code) @ turn.T
        assert self.camera.matrix is not None  # every stage has a pinhole camera
        scene: dict[str, Any] = {
            "rotation": turn @ self.own_rotation(code),
            "translation_m": place @ turn.T + shift,
            "camera_matrix": self.camera.matrix,
            "light": light,
            "confidence": code[CONFIDENCE][..., 0].float() if CONFIDENCE in code else None,
            "seed": jitter_seed(code),
        }
        color = code[COLOR].float() if COLOR in self.layout else None
        behind = self._behind(self.ground(cam_from_world), scene, backgrounds)
        return self._renderer(**scene, color=color, backgrounds=behind)

    def _behind(
        self, ground: Ground | None, scene: Mapping[str, Any], backgrounds: Tensor | None
    ) -> Float[Tensor, "batch 3 height width"]:
        """What is seen past the objects: what was given, black, or the ground with their shadows."""
        if backgrounds is not None:
            return backgrounds
        light: Tensor = scene["light"]
        if ground is None:
            return light.new_zeros(len(light), 3, self.camera.height, self.camera.width)
        return ground.image(self.stage.ambient, light, self._renderer.shadows(**scene, ground=ground))
