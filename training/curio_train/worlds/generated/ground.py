"""Camera, light and ground of the worlds whose objects stand on the ground: Chairs, Multi and Light.

The paper gives no numbers. Ours were fixed before any training:

* the world frame has y up and its origin on the ground; an object's origin is its lowest point, so y is 0, and its yaw
  rotates it about y; at yaw 0 it faces +z, where the camera stands;
* positions are uniform on a square of 1.7 m round the origin; objects do not touch whatever their yaw;
* the camera is 4 m from a point 0.15 m above the origin and looks down on it by 40°. At a focal length of 175 px for
  128x128 images (field of view 40°) every object is whole in the frame, and in the novel view from 90° round the
  vertical axis, too; the horizon is above the frame;
* the ground is a grey of 0.5 (sRGB); ambient radiance 0.3, sun of strength 0.7. A sun that does not move is 50° high,
  to the left of the camera;
* objects throw shadows, on the ground and on each other; as rendering/shadows.py says, shadows have all gradients but
  that of a shadow's border on another object.

Codes are in the world frame. An exported model answers in the camera frame, which never moves.
"""

import numpy as np
import torch

from curio_train.camera import square_matrix
from curio_train.geometry import Pose, camera_looking_at
from curio_train.meshes.meshes import Mesh
from curio_train.scene_code import TRANSLATION, Field
from curio_train.worlds.base import Camera
from curio_train.worlds.generated.mesh_world import MeshKind
from curio_train.worlds.generated.scene_setup import SceneSetup

SIDE_PX, FOCAL_PX = 128, 175.0
DISTANCE_M, ELEVATION_DEG, TARGET_HEIGHT_M = 4.0, 40.0, 0.15
REACH_M = 0.85
GROUND_SRGB = 0.5
AMBIENT, SUN = 0.3, 0.7
SUN_ELEVATION_DEG, SUN_AZIMUTH_DEG = 50.0, 40.0
OUTLINE_SAMPLES = 256
"""Objects of 15 to 40 pixels: measured, half the usual number costs 0.001 of the gradients' cosine."""

POSITION_FIELD = Field(
    TRANSLATION, 3, unit="m", frame="world", lower=(-REACH_M, 0.0, -REACH_M), upper=(REACH_M, 0.0, REACH_M)
)


def ground_setup() -> SceneSetup:
    """The setup of all worlds on the ground."""
    up, across = np.sin(np.radians(ELEVATION_DEG)), np.cos(np.radians(ELEVATION_DEG))
    target = torch.tensor([0.0, TARGET_HEIGHT_M, 0.0], dtype=torch.float64)
    rotation, translation_m = camera_looking_at(target + DISTANCE_M * torch.tensor([0.0, up, across]), target)
    elevation, azimuth = np.radians(SUN_ELEVATION_DEG), np.radians(SUN_AZIMUTH_DEG)
    level = np.cos(elevation)
    sun = SUN * np.array([-level * np.sin(azimuth), np.sin(elevation), level * np.cos(azimuth)])
    return SceneSetup(
        Camera(SIDE_PX, SIDE_PX, square_matrix(FOCAL_PX, SIDE_PX), is_default=True),
        Pose(rotation.numpy(), translation_m.numpy()),
        center_m=(0.0, 0.0, 0.0),
        up=(0.0, 1.0, 0.0),
        ambient=AMBIENT,
        sun=tuple(sun.tolist()),
        ground_srgb=GROUND_SRGB,
        object_shadows=True,
        outline_samples=OUTLINE_SAMPLES,
    )


def standing_kind(name: str, mesh: Mesh, num_slots: int) -> MeshKind:
    """A kind of object that stands on the ground: its radius is that of the smallest cylinder about its y axis.

    Args:
        name: For people.
        mesh: With y up and its lowest point at y = 0.
        num_slots: Slots of the scene code.
    """
    radius_m = float(np.linalg.norm(mesh.vertices_m[:, [0, 2]], axis=1).max())
    return MeshKind(name, mesh, num_slots, radius_m)
