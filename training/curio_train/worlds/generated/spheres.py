"""Spheres: three spheres of any position and colour on black (paper, section "Analysis"; 6 degrees of freedom each).

The paper gives no numbers. Ours were fixed before any training:

* a camera of focal length 148 px for 128x128 images (field of view 47°) looks along z at a cube 3 m away, 1.4 m wide;
  sphere centres are uniform in the cube, spheres do not touch. A sphere of radius 0.2 m is then always whole in
  the frame, 8 to 13 pixels in radius: only its size shows its distance;
* the cube looks the same from all sides, so the novel view, 90° round its centre, shows every sphere, too;
* colours of any hue, saturation 0.5 to 1, value 0.7 to 1, over black as in Circles;
* one light from the upper left behind the camera, strength 0.7 over an ambient radiance of 0.3: nothing clips at white.

Codes are in the camera frame, which here is the world's. The heads are the paper's: linear positions, sigmoid colours.
"""

from curio_train.camera import square_matrix
from curio_train.geometry import Pose
from curio_train.meshes.shapes import sphere
from curio_train.scene_code import TRANSLATION, Field
from curio_train.worlds.base import Camera
from curio_train.worlds.generated.fields import COLOR_FIELD
from curio_train.worlds.generated.generated_world import GeneratedWorld
from curio_train.worlds.generated.mesh_world import MeshKind
from curio_train.worlds.generated.orientation import NoRotation
from curio_train.worlds.generated.scene_setup import SceneSetup
from curio_train.worlds.options import SpheresOptions

SIDE_PX, FOCAL_PX = 128, 148.0
DISTANCE_M, REACH_M = 3.0, 0.7
RADIUS_M = 0.2
NUM_SPHERES = 3

_NEAR, _FAR = DISTANCE_M - REACH_M, DISTANCE_M + REACH_M
POSITION_FIELD = Field(
    TRANSLATION, 3, unit="m", frame="camera", lower=(-REACH_M, -REACH_M, _NEAR), upper=(REACH_M, REACH_M, _FAR)
)


def spheres_setup() -> SceneSetup:
    """Camera and light of all worlds of spheres."""
    return SceneSetup(
        Camera(SIDE_PX, SIDE_PX, square_matrix(FOCAL_PX, SIDE_PX), is_default=True),
        Pose.identity(),
        center_m=(0.0, 0.0, DISTANCE_M),
        up=(0.0, -1.0, 0.0),
        ambient=0.3,
        sun=(-0.3, -0.5, -0.387),  # of length 0.7
    )


def sphere_kind(num_slots: int) -> MeshKind:
    """The spheres."""
    return MeshKind("sphere", sphere(RADIUS_M, subdivisions=2), num_slots, RADIUS_M)


def build(options: SpheresOptions) -> GeneratedWorld:
    """The world of three spheres."""
    kinds = [sphere_kind(NUM_SPHERES)]
    return GeneratedWorld("spheres", kinds, spheres_setup(), POSITION_FIELD, NoRotation(), [COLOR_FIELD])
