"""Small trials of the renderer and of training, to be run in a process of their own."""

import time

import numpy as np
import torch

from curio_train.errors import RendererError
from curio_train.geometry import matrix_from_rotation_6d
from curio_train.learning.losses import image_loss
from curio_train.meshes.shapes import box, sphere
from curio_train.networks.paper.network import PoseNetwork
from curio_train.rendering.renderer import Renderer
from curio_train.scene_code import LIGHT, ROTATION_6D, TRANSLATION, Field, Layout

_SMALL_PX, _SIDE_PX = 32, 128
_BATCH, _STEPS = 16, 3


def _camera_matrix(side: int) -> np.ndarray:
    centre = (side - 1) / 2
    return np.array([[side, 0, centre], [0, side, centre], [0, 0, 1]], dtype=np.float64)


def render_a_box() -> float:
    """Share of the pixels that a white box covers whose face fills a quarter of the picture.

    Raises:
        RendererError: The picture shows something else.
    """
    renderer = Renderer([box((1.0, 1.0, 0.01))], [0], _SMALL_PX, _SMALL_PX, ambient=1.0)
    picture = renderer(
        torch.eye(3)[None, None],
        torch.tensor([[[0.0, 0.0, 2.005]]]),
        camera_matrix=_camera_matrix(_SMALL_PX),
        backgrounds=torch.zeros(1, 3, _SMALL_PX, _SMALL_PX),
        light=torch.zeros(1, 3),
    )
    share = float((picture.mean(dim=1) > 0.25).float().mean())
    if not 0.24 <= share <= 0.26:
        raise RendererError(f"the test picture's box covers {share:.1%} of it, expected 25 %")
    return share


def images_per_second() -> float:
    """Images a second of learning by re-rendering: network, renderer, and back through both, as it is now."""
    layout = Layout(
        (
            Field(TRANSLATION, 3, unit="m", frame="camera", lower=(-0.1, -0.1, 0.4), upper=(0.1, 0.1, 0.6)),
            Field(ROTATION_6D, 6, frame="camera", lower=(-1.0,) * 6, upper=(1.0,) * 6),
            Field(LIGHT, 3, per_object=False, frame="camera", lower=(-1.0,) * 3, upper=(1.0,) * 3),
        )
    )
    network = PoseNetwork(layout, _SIDE_PX)
    renderer = Renderer([sphere(0.05, subdivisions=5)], [0], _SIDE_PX, _SIDE_PX, ambient=0.3)
    images = torch.rand(_BATCH, 3, _SIDE_PX, _SIDE_PX, generator=torch.Generator().manual_seed(0))
    black = torch.zeros_like(images)

    def step() -> None:
        code = network(images)
        rotation = matrix_from_rotation_6d(code[ROTATION_6D])
        matrix = _camera_matrix(_SIDE_PX)
        again = renderer(rotation, code[TRANSLATION], camera_matrix=matrix, backgrounds=black, light=code[LIGHT])
        image_loss(again, images).backward()

    step()  # compiles the kernels
    begun = time.perf_counter()
    for _ in range(_STEPS):
        step()
    return _BATCH * _STEPS / (time.perf_counter() - begun)
