"""Whether given meshes are those of the objects that were detected: drawings of other meshes look like wrong poses."""

import numpy as np
from curio_serve.imaging.camera import PinholeCamera

from curio_train.drawing.pictures import SceneContext
from curio_train.drawing.scenes import Placed, Scene
from curio_train.errors import DataError, UsageError
from curio_train.meshes.meshes import METRES

_TOLERANCE = 0.05  # of the box's size in the image, between the mesh's corners and those of box_px


def check_meshes(scene: Scene, around: SceneContext) -> None:
    """Refuse meshes that are not those of a scene's objects.

    Args:
        scene: Its objects have the corners that were written when they were detected, or none.
        around: The meshes.

    Raises:
        UsageError: One mesh without a name for several kinds of objects.
        DataError: An object without a mesh, or with one whose box is not the one that was detected.
    """
    unnamed = sorted({item.kind for item in scene.objects} - set(around.meshes))
    if "" in around.meshes and len(unnamed) > 1:
        raise UsageError(
            f"one --mesh FILE is for one kind of object, and {scene.name} has {', '.join(unnamed)}; name each with "
            f"--mesh {unnamed[0]}=FILE --mesh {unnamed[1]}=FILE"
        )
    camera = PinholeCamera(scene.camera_matrix, scene.distortion)
    for item in scene.objects:
        _check_box(item, around, camera, scene.name)


def _check_box(item: Placed, around: SceneContext, camera: PinholeCamera, where: str) -> None:
    corners_m = around.mesh(item.kind).box_corners_m
    if item.box_px is None:
        return
    found_px = camera.project(item.pose.apply(corners_m))
    size_px = np.linalg.norm(np.ptp(item.box_px, axis=0))
    off_px = np.linalg.norm(found_px - item.box_px, axis=1).max()
    if off_px > _TOLERANCE * size_px:
        raise DataError(
            f"{where}: the mesh is not the {item.kind} that was detected: its box is {off_px:.0f} px away from box_px, "
            f"which is {size_px:.0f} px large. Give the mesh of that object (--mesh {item.kind}=FILE) and its unit "
            f"(--mesh-unit, {', '.join(METRES)}); if you changed the pose in the file, remove its box_px"
        )
