"""Worlds of meshes of known shape before one camera: how a scene code becomes an image, and the networks for it."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float
from torch import Tensor

from curio_train.config import DecoderKind, NetworkConfig
from curio_train.geometry import Pose
from curio_train.meshes.meshes import Mesh
from curio_train.networks.base import StageNetwork
from curio_train.networks.grid import CellGrid
from curio_train.networks.set_detector import HEAT_MAP, SetDetector, dense_loss
from curio_train.rendering.ground import Ground
from curio_train.rendering.renderer import Renderer
from curio_train.scene_code import COLOR, CONFIDENCE, TRANSLATION, Layout, SceneCode
from curio_train.worlds.base import CameraFrameOutputs, ObjectKind, Split, World, jitter_seed
from curio_train.worlds.generated.orientation import Orientation
from curio_train.worlds.generated.outputs import WorldFrameOutputs
from curio_train.worlds.generated.scene_setup import SceneSetup
from curio_train.worlds.image_sets import StoredImages, stored_images


@dataclass(frozen=True)
class MeshKind:
    """A kind of object."""

    name: str
    """Name that people read."""
    mesh: Mesh
    """Its shape; white if the scene code has its colour."""
    num_slots: int
    """Slots of the scene code; kinds take theirs one after the other."""
    radius_m: float
    """Radius of a sphere round the object (on the ground, of a vertical cylinder): objects are drawn so far apart."""


class MeshWorld(World):
    """Objects of known shape under one light; scene codes are in the world frame of the setup."""

    decoders: ClassVar[frozenset[DecoderKind]] = frozenset({"whole", "cells"})

    def __init__(
        self,
        name: str,
        layout: Layout,
        kinds: Sequence[MeshKind],
        setup: SceneSetup,
        orientation: Orientation,
        constants: Mapping[str, Any],
    ) -> None:
        """Build the renderer.

        Args:
            name: As on the command line.
            layout: Of the scene code.
            kinds: The objects.
            setup: Camera, light and ground.
            orientation: How scene codes describe rotations.
            constants: What the draws depend on beside layout, meshes and setup, as JSON; a changed one makes new image
                sets.

        Raises:
            RendererError: No usable libLLVM.
        """
        self.name, self.layout, self.kinds, self.setup, self.camera = name, layout, tuple(kinds), setup, setup.camera
        self.orientation, self._constants = orientation, constants
        ends = np.cumsum([kind.num_slots for kind in kinds]).tolist()
        self.objects = tuple(
            ObjectKind(
                kind.name,
                tuple(range(end - kind.num_slots, end)),
                kind.mesh.diameter_m,
                kind.mesh.box_corners_m,
                kind.mesh.sha256,
            )
            for kind, end in zip(kinds, ends, strict=True)
        )
        self._renderer = Renderer(
            [kind.mesh for kind in kinds],
            [number for number, kind in enumerate(kinds) for _ in range(kind.num_slots)],
            setup.camera.width,
            setup.camera.height,
            ambient=setup.ambient,
            outline_samples=setup.outline_samples,
            object_shadows=setup.object_shadows,
        )

    @property
    def recipe(self) -> dict[str, Any]:
        """All that the images depend on, as JSON; image sets are named by its hash."""
        setup = self.setup
        recipe: dict[str, Any] = {
            "constants": dict(self._constants),
            "fields": [asdict(field) for field in self.layout.fields],
            "kinds": [(kind.name, kind.mesh.sha256, kind.num_slots) for kind in self.kinds],
            "camera": (self.camera.width, self.camera.height, np.asarray(self.camera.matrix).tolist()),
            "cam_from_world": [np.asarray(part).tolist() for part in setup.cam_from_world],
            "light": (setup.ambient, setup.sun),
        }
        if setup.ground_srgb is not None:
            recipe |= {"ground": setup.ground_srgb, "shadows": "ground and objects"}
        return recipe

    @property
    def outputs(self) -> CameraFrameOutputs:
        """Conversion between scene codes and the outputs of exported models."""
        if self.setup.ground_srgb is None:
            return super().outputs
        return WorldFrameOutputs(self.layout, self.setup, self.orientation)

    @property
    def radii_m(self) -> list[float]:
        """Radius of each slot's object, see :class:`MeshKind`."""
        return [kind.radius_m for kind in self.kinds for _ in range(kind.num_slots)]

    def render(self, code: SceneCode, backgrounds: Tensor | None = None) -> Tensor:
        """The scenes from the world's own camera, over ``backgrounds`` or the world's own background.

        Objects are as transparent as their confidence if the code has one, even if the layout has none.
        """
        return self._render(code, self.setup.cam_from_world, backgrounds)

    def novel_view(self, code: SceneCode) -> Tensor:
        """Images of scenes from the setup's novel view."""
        return self._render(code, self.setup.novel_cam_from_world, None)

    def source(self, split: Split, seed: int, *, with_code: bool, cache: Path) -> StoredImages:
        """2,000, 500 and 500 images, the paper's numbers."""
        return stored_images(self, self.recipe, split, seed, with_code=with_code, cache=cache)

    def network(self, config: NetworkConfig) -> StageNetwork:
        """The paper's network, or the dense detector."""
        if config.reading == "cells":
            return SetDetector(self.layout, self._slots_of_kinds, self._new_grid())
        return super().network(config)

    def code_loss(self, predicted: SceneCode, true: SceneCode) -> Float[Tensor, ""]:
        """Eq. 1, or of the dense detector the loss of all cells, mean over the batch."""
        if HEAT_MAP not in predicted:
            return super().code_loss(predicted, true)
        grid = self.grid.to(true[TRANSLATION].device)
        return dense_loss(self.layout, self._slots_of_kinds, grid, predicted, true, self.slot_infos).mean()

    @property
    def _slots_of_kinds(self) -> tuple[tuple[int, ...], ...]:
        return tuple(kind.slots for kind in self.objects)

    @cached_property
    def grid(self) -> CellGrid:
        """The cells of the world's images."""
        return self._new_grid()

    def _new_grid(self) -> CellGrid:
        assert self.camera.matrix is not None
        size = self.camera.width, self.camera.height
        position, on_plane = self.layout[TRANSLATION], self.setup.ground_srgb is not None
        return CellGrid(position, self.camera.matrix, self.setup.cam_from_world, size, on_plane=on_plane)

    def _render(self, code: SceneCode, camera: Pose[np.ndarray], backgrounds: Tensor | None) -> Tensor:
        position = code[TRANSLATION].float()
        cam_from_world = camera.to(position)
        assert self.camera.matrix is not None  # every setup has a pinhole camera
        scene: dict[str, Any] = {
            "rotation": cam_from_world.rotation @ self.orientation.rotation(code),
            "translation_m": cam_from_world.apply(position),
            "camera_matrix": self.camera.matrix,
            "light": self.setup.light(code) @ cam_from_world.rotation.T,
            "confidence": code[CONFIDENCE][..., 0].float() if CONFIDENCE in code else None,
            "seed": jitter_seed(code),
        }
        color = code[COLOR].float() if COLOR in self.layout else None
        behind = self._background(self.setup.ground(camera), scene, backgrounds)
        return self._renderer(**scene, color=color, backgrounds=behind)

    def _background(
        self, ground: Ground | None, scene: Mapping[str, Any], backgrounds: Tensor | None
    ) -> Float[Tensor, "batch 3 height width"]:
        """The images behind the objects: those given, or black, or the ground with the objects' shadows."""
        if backgrounds is not None:
            return backgrounds
        light: Tensor = scene["light"]
        if ground is None:
            return light.new_zeros(len(light), 3, self.camera.height, self.camera.width)
        return ground.image(self.setup.ambient, light, self._renderer.shadows(**scene, ground=ground))
