"""Who hides whom: alpha, order by depth, confidence."""

from typing import Any

import numpy as np
import pytest
import torch
from curio_train.meshes.meshes import Mesh
from curio_train.rendering.renderer import Renderer
from curio_train.rendering.stock import PosedMesh, emitters, load_scene, sensor

SIZE = 96
MATRIX = np.array([[130.0, 0, 45], [0, 130.0, 50], [0, 0, 1]])
RED, GREEN = torch.tensor([1.0, 0, 0]), torch.tensor([0, 1.0, 0])


@pytest.fixture(scope="module")
def pair(meshes) -> Renderer:
    """A concave object and a box, without colours of their own, evenly lit."""
    root = Mesh(meshes["root"].vertices_m, meshes["root"].faces)
    return Renderer([root, meshes["box"]], [0, 1], SIZE, SIZE, ambient=1.0)


def render(renderer: Renderer, codes: Any, confidence: torch.Tensor | None = None, backgrounds=None) -> torch.Tensor:
    """Red first object and green second one, over black unless told otherwise."""
    count = len(codes.rotation)
    return renderer(
        codes.rotation,
        codes.translation_m,
        camera_matrix=MATRIX,
        backgrounds=torch.zeros(count, 3, SIZE, SIZE) if backgrounds is None else backgrounds,
        light=torch.zeros(count, 3),
        color=torch.stack([RED, GREEN]).expand(count, 2, 3),
        confidence=confidence,
    )


def intersection_over_union(a: np.ndarray, b: np.ndarray) -> float:
    assert b.sum() > 50, "the object is hardly in the picture"
    return float((a & b).sum() / (a | b).sum())


def stock_depths(mitsuba: Any, posed: PosedMesh) -> np.ndarray:
    """Distance [height * 4, width * 4] along 16 rays a pixel, infinite where nothing is hit."""
    camera = sensor(mitsuba, MATRIX, SIZE, SIZE, samples_per_pixel=1)
    camera["film"] |= {"width": SIZE * 4, "height": SIZE * 4}
    integrator = {"type": "aov", "aovs": "distance:depth"}
    scene = load_scene(mitsuba, [posed], camera, emitters(1.0, np.zeros(3)), integrator)
    depths = np.array(mitsuba.render(scene, spp=1))[..., -1]
    return np.where(depths > 0, depths, np.inf)


def test_masks_equal_stock_depths(mitsuba, meshes, draw, pair) -> None:
    codes = draw(24, 2, 11)
    # Moved together until some cross: occlusion is then decided sample by sample.
    codes.translation_m[:, 1, 2] = codes.translation_m[:, 0, 2] + torch.linspace(-0.08, 0.08, 24)
    ours = render(pair, codes).numpy()
    scores = []
    for i in range(24):
        poses = [[v[i, slot].double().numpy() for v in (codes.rotation, codes.translation_m)] for slot in range(2)]
        depths = [
            stock_depths(mitsuba, PosedMesh(meshes[name], *pose))
            for name, pose in zip(("root", "box"), poses, strict=True)
        ]
        for slot in range(2):
            # Most of a pixel's 16 samples decide.
            expected = (depths[slot] < depths[1 - slot]).reshape(SIZE, 4, SIZE, 4).mean((1, 3)) > 0.5
            if expected.sum() > 50:
                scores.append(intersection_over_union(ours[i, slot] > 0.5, expected))
    assert len(scores) > 30
    assert np.mean(scores) >= 0.98


def test_nearer_object_hides_the_other_whatever_its_slot(draw, pair) -> None:
    codes = draw(4, 2, 3)
    codes.translation_m[:] = torch.tensor([[0, 0, 0.3], [0, 0, 0.6]])
    middle = (slice(None), slice(None), 50, 45)
    assert torch.allclose(render(pair, codes)[middle], RED, atol=1e-6)
    codes.translation_m[:] = codes.translation_m.flip(1)
    assert torch.allclose(render(pair, codes)[middle], GREEN, atol=1e-6)


@pytest.mark.parametrize(("a", "b"), [(1.0, 0.0), (0.0, 1.0), (0.6, 0.3)])
def test_confidence_is_opacity(draw, pair, a: float, b: float) -> None:
    """Paper, "Differentiable Rendering with Confidence": nearest first, each lets 1 − confidence through."""
    codes = draw(4, 2, 3)
    codes.translation_m[:] = torch.tensor([[0, 0, 0.3], [0, 0, 0.6]])
    blue = torch.tensor([0, 0, 1.0])
    backgrounds = blue[None, :, None, None].expand(4, 3, SIZE, SIZE)
    image = render(pair, codes, torch.tensor([[a, b]]).expand(4, 2), backgrounds)
    expected = a * RED + (1 - a) * b * GREEN + (1 - a) * (1 - b) * blue
    assert torch.allclose(image[:, :, 50, 45], expected, atol=1e-6)
    assert torch.allclose(image[:, :, 0, 0], blue, atol=0)


def test_equal_depths_show_the_earlier_slot(meshes, draw) -> None:
    twins = Renderer([meshes["box"]], [0, 0], SIZE, SIZE, ambient=1.0)
    codes = draw(4, 2, 3)
    codes.translation_m[:] = torch.tensor([0, 0, 0.4])
    codes.rotation[:, 1] = codes.rotation[:, 0]
    confidence = torch.full((4, 2), 1.0, requires_grad=True)
    image = render(twins, codes, confidence)
    assert torch.allclose(image[:, :, 50, 45], RED, atol=1e-6)
    image.sum().backward()
    assert torch.isfinite(confidence.grad).all()


def test_objects_hide_nothing_through_others_of_the_static_scene(meshes, draw) -> None:
    """Wherever the camera stands, a slot shows its own kind and nothing of the others."""
    codes = draw(32, 1, 7)
    kinds = [meshes[name] for name in ("root", "box", "ring", "pebble")]
    together = Renderer(kinds, [1], 64, 64, ambient=0.5)
    alone = Renderer([meshes["box"]], [0], 64, 64, ambient=0.5)
    images = [
        r(
            codes.rotation,
            codes.translation_m * 3,
            camera_matrix=np.array([[250.0, 0, 32], [0, 250, 32], [0, 0, 1]]),
            backgrounds=codes.backgrounds,
            light=codes.light,
        )
        for r in (together, alone)
    ]
    assert torch.allclose(*images, atol=1e-4)
