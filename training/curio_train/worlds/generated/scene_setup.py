"""What is the same in all scenes of a world of meshes: camera, light and ground."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from curio_train.geometry import Pose, direction_from_hemisphere
from curio_train.rendering.ground import Ground
from curio_train.scene_code import LIGHT, TRANSLATION, SceneCode
from curio_train.worlds.base import Camera


@dataclass(frozen=True, eq=False)
class SceneSetup:
    """Camera, light and ground of a world's scenes."""

    camera: Camera
    """Camera with its matrix."""
    cam_from_world: Pose[np.ndarray]
    """Pose of the camera."""
    center_m: tuple[float, float, float]
    """World frame: the novel view's camera orbits this point."""
    up: tuple[float, float, float]
    """World frame: axis of that orbit."""
    ambient: float
    """Radiance from everywhere."""
    sun: tuple[float, float, float]
    """World frame, towards the light; its length is the strength. If scene codes have a light, only the strength
    counts."""
    ground_srgb: float | None = None
    """Grey value of the ground y = 0, on which objects stand and throw shadows; None: they float before black."""
    object_shadows: bool = False
    """Whether objects throw shadows on each other."""
    outline_samples: int = 512
    """Points on each object's outline, for the gradient."""

    @property
    def novel_cam_from_world(self) -> Pose[np.ndarray]:
        """Pose of the camera after an orbit of 90° round the scene's centre (the paper's image error)."""
        orbit = Rotation.from_rotvec(np.pi / 2 * np.array(self.up)).as_matrix()
        center = np.array(self.center_m)
        rotation = self.cam_from_world.rotation @ orbit.T
        return Pose(
            rotation, self.cam_from_world.translation_m + self.cam_from_world.rotation @ center - rotation @ center
        )

    def light(self, code: SceneCode) -> Float[Tensor, "batch 3"]:
        """Vector towards the sun in each scene, world frame; the length is the strength."""
        sun = code[TRANSLATION].new_tensor(self.sun, dtype=torch.float32)
        if LIGHT in code:
            return direction_from_hemisphere(code[LIGHT].float()) * sun.norm()
        return sun.expand(len(code[TRANSLATION]), 3)

    def ground(self, cam_from_world: Pose[np.ndarray]) -> Ground | None:
        """The ground in the frame of a camera."""
        if self.ground_srgb is None:
            return None
        up = np.asarray(cam_from_world.rotation)[:, 1]
        return Ground(up, -float(up @ np.asarray(cam_from_world.translation_m)), self.ground_srgb)
