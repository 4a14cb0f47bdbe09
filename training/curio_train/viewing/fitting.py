"""Moves one object of a page by render-and-compare, from where it was put."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch

from curio_train.camera import scale_matrix
from curio_train.errors import DataError
from curio_train.geometry import Pose, rotation_6d_from_matrix
from curio_train.refinement.render_and_compare import RenderAndCompare
from curio_train.scene_code import COLOR, LIGHT, ROTATION_6D, TRANSLATION, poses
from curio_train.viewing.pages import Page
from curio_train.worlds.base import Camera


class Step(NamedTuple):
    """The object after one step."""

    pose: Pose
    """cam_from_obj, metres."""
    loss: float
    """Mean robust residual between the crop around the object and its re-rendering, 0 to 1."""


def walk(page: Page, number: int) -> Iterator[Step]:
    """The pose after each step of the optimisation.

    Args:
        page: With the image that the object's rendering is to resemble.
        number: Of the object in the page's scene.

    Raises:
        DataError: The object is not in front of the camera.
        RendererError: There is no usable libLLVM.
    """
    item, mesh = page.scene.objects[number], page.context.mesh(page.scene.objects[number].kind)
    height, width = page.image.shape[:2]
    matrix = scale_matrix(page.scene.camera_matrix, (page.scene.width, page.scene.height), (width, height))
    middle = Pose(np.eye(3), mesh.box_corners_m.mean(axis=0))  # around which crops are cut
    position_m = (item.pose @ middle).translation_m
    if position_m[2] <= 0:
        raise DataError(f"{item.kind or 'the object'} is not in front of the camera (z {position_m[2]:.3g} m); move it")
    code = {
        TRANSLATION: _tensor(position_m)[None],
        ROTATION_6D: rotation_6d_from_matrix(_tensor(item.pose.rotation))[None],
        LIGHT: _tensor(page.light),
        COLOR: _tensor(item.color_srgb)[None],
    }
    image = torch.from_numpy(np.ascontiguousarray(page.image)).permute(2, 0, 1)[None]
    refiner = RenderAndCompare(mesh.moved(-middle.translation_m), Camera(width, height, matrix), mesh.diameter_m)
    for found, residual in refiner.steps(image, code):
        yield Step(poses(found)[0] @ middle.inverse(), float(residual))


def _tensor(values: Sequence[float] | np.ndarray) -> torch.Tensor:
    return torch.tensor(np.array(values), dtype=torch.float32)[None]
