"""Moves one object of a page by render-and-compare, from where it was put."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch

from curio_train.drawing.pictures import LIGHT as DEFAULT_LIGHT
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
    """Robust difference between the crop around the object and its re-rendering; see ``render_and_compare``."""


def walk(page: Page, number: int) -> Iterator[Step]:
    """The pose after each step of the optimisation.

    Args:
        page: Its image is what the object's rendering is to look like.
        number: Of the object in the page's scene.

    Raises:
        RendererError: There is no usable libLLVM.
    """
    item = page.scene.objects[number]
    height, width = page.image.shape[:2]
    scale = np.diag([width / page.scene.width, height / page.scene.height, 1.0])
    refine = RenderAndCompare(page.context.mesh(item.kind), Camera(width, height, scale @ page.scene.camera_matrix))
    light = page.scene.light if page.scene.light is not None else page.context.light
    code = {
        TRANSLATION: _tensor(item.pose.translation_m)[None],
        ROTATION_6D: rotation_6d_from_matrix(_tensor(item.pose.rotation)),
        LIGHT: _tensor(DEFAULT_LIGHT if light is None else light),
        COLOR: _tensor(item.color_srgb)[None],
    }
    image = torch.from_numpy(np.ascontiguousarray(page.image)).permute(2, 0, 1)[None]
    for found, loss in refine.walk(image, code):
        (pose,) = poses(found)
        yield Step(pose, float(loss))


def _tensor(values: object) -> torch.Tensor:
    return torch.tensor(np.array(values), dtype=torch.float32)[None]
