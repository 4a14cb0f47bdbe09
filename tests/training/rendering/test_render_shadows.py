"""Shadows on the ground and on other objects: stock Mitsuba's, with gradients that equal differences."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from curio_train.meshes.meshes import Mesh
from curio_train.rendering.ground import Ground
from curio_train.rendering.path_tracing import ground_disk
from curio_train.rendering.renderer import Renderer
from curio_train.rendering.stock import PosedMesh, emitters, load_scene, sensor
from scipy.spatial.transform import Rotation
from stock.gradient_check import TURN, central_differences, cosine, gradients, turned

SIZE, FINER = 64, 8
MATRIX = np.array([[70.0, 0, 30], [0, 70.0, 26], [0, 0, 1]])
UP = np.array([0.1, -1.0, -0.8]) / np.linalg.norm([0.1, -1.0, -0.8])
GROUND = Ground(UP, 0.35, 0.6)
LIGHT = torch.tensor([0.25, -0.7, -0.1])
NUM_CODES = 64
SAMPLES_OF_CONFIDENCE, SAMPLES_OF_SHIFTS, SAMPLES_OF_TURN = 16, 100, 256
"""Of the converged renderings: shadows are linear in the confidence, so its differences are nearly free of noise, and
turns move outlines least, so theirs have most of it."""


def draw_scene(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Two objects an image that float over the ground before the camera, the first nearer to the light."""
    rng = np.random.default_rng(seed)
    place = rng.uniform([-0.04, -0.08, 0.32], [0.02, -0.04, 0.36], (count, 2, 3))
    place[:, 1] = place[:, 0] - 0.09 * (LIGHT / LIGHT.norm()).numpy() + rng.uniform(-0.02, 0.02, (count, 3))
    rotation = Rotation.random(2 * count, random_state=seed).as_matrix().reshape(count, 2, 3, 3)
    return torch.tensor(rotation, dtype=torch.float32), torch.tensor(place, dtype=torch.float32)


@pytest.fixture(scope="module")
def pebbles(meshes) -> Renderer:
    """Two convex objects, lit by the sun alone."""
    stones = [Mesh(meshes["pebble"].vertices_m, meshes["pebble"].faces), meshes["pebble"]]
    return Renderer(stones, [0, 1], SIZE, SIZE, ambient=0.0, samples_per_pixel=16, object_shadows=True)


def our_shadow(renderer: Renderer, rotation, translation_m, **more: Any) -> torch.Tensor:
    arguments = {"camera_matrix": MATRIX, "ground": GROUND, "light": LIGHT.expand(len(rotation), 3)} | more
    return renderer.shadows(rotation, translation_m, **arguments)


def stock_image(mitsuba: Any, meshes: list[Mesh], rotation, translation_m, *, ground: bool) -> np.ndarray:
    """[height, width, 4], sRGB and alpha of many samples a pixel, under the sun alone."""
    matrix = np.diag([FINER, FINER, 1]) @ MATRIX
    matrix[:2, 2] += (FINER - 1) / 2
    posed = [PosedMesh(m, *(v[k].double().numpy() for v in (rotation, translation_m))) for k, m in enumerate(meshes)]
    sun = {name: light for name, light in emitters(0.0, LIGHT.double().numpy()).items() if name == "sun"}
    around = sun | ({"ground": ground_disk(mitsuba, GROUND)} if ground else {})
    camera = sensor(mitsuba, matrix, SIZE * FINER, SIZE * FINER, samples_per_pixel=1)
    scene = load_scene(mitsuba, posed, camera, around, {"type": "direct", "hide_emitters": True})
    image = np.array(mitsuba.render(scene, spp=1)).clip(0, 1)
    color = image[..., :3]
    image[..., :3] = np.where(color <= 0.0031308, 12.92 * color, 1.055 * np.maximum(color, 1e-6) ** (1 / 2.4) - 0.055)
    return image.reshape(SIZE, FINER, SIZE, FINER, 4).mean((1, 3))


def test_shadows_are_stock_mitsubas(mitsuba, meshes, pebbles) -> None:
    """Masks on the ground, and whole images, in which objects shadow each other."""
    rotation, translation_m = draw_scene(12, 0)
    shadow = our_shadow(pebbles, rotation, translation_m)
    ours = pebbles(
        rotation,
        translation_m,
        camera_matrix=MATRIX,
        backgrounds=GROUND.image(0.0, LIGHT.expand(12, 3), shadow),
        light=LIGHT.expand(12, 3),
    )
    stones = [Mesh(meshes["pebble"].vertices_m, meshes["pebble"].faces), meshes["pebble"]]
    overlaps, differences, mutual = [], [], []
    for i in range(12):
        stock = stock_image(mitsuba, stones, rotation[i], translation_m[i], ground=True)
        objects = stock_image(mitsuba, stones, rotation[i], translation_m[i], ground=False)
        bare = objects[..., 3] == 0
        expected, found = (stock[..., 0] < stock[bare, 0].max() / 2) & bare, (shadow[i, 0].numpy() > 0.5) & bare
        assert expected.sum() > 30
        overlaps.append((expected & found).sum() / (expected | found).sum())
        difference = np.abs(ours[i].permute(1, 2, 0).numpy() - stock[..., :3])
        differences.append(difference[~bare | expected].mean())
        mutual.append(difference[objects[..., 3] == 1].mean())
    assert np.mean(overlaps) >= 0.98
    assert np.mean(differences) <= 0.01
    assert np.mean(mutual) <= 0.01


def test_without_object_shadows_the_image_is_another(meshes, pebbles) -> None:
    """The comparison above can fail: the scenes have shadows on objects."""
    rotation, translation_m = draw_scene(12, 0)
    plain = Renderer([meshes["pebble"]], [0, 0], SIZE, SIZE, ambient=0.0, samples_per_pixel=16)
    shaded = Renderer([meshes["pebble"]], [0, 0], SIZE, SIZE, ambient=0.0, samples_per_pixel=16, object_shadows=True)
    black, light = torch.zeros(12, 3, SIZE, SIZE), LIGHT.expand(12, 3)
    images = [r(rotation, translation_m, camera_matrix=MATRIX, backgrounds=black, light=light) for r in (plain, shaded)]
    assert (images[0] - images[1]).min() > -1e-6
    assert (images[0] - images[1]).mean() > 0.005


def displaced(renderer: Renderer, codes: dict[str, torch.Tensor], target: torch.Tensor | None, seed: int) -> Any:
    """From displacements to the squared error of each shadow; without target to the shadows."""

    def loss(moved: dict[str, torch.Tensor]) -> torch.Tensor:
        shadow = our_shadow(
            renderer,
            turned(codes["rotation"], moved[TURN]),
            codes["translation_m"] + moved["translation_m"],
            light=codes["light"] + moved["light"],
            confidence=codes["confidence"] + moved["confidence"],
            seed=seed,
        )
        return shadow if target is None else (shadow - target).square().flatten(1).sum(1)

    return loss


@pytest.fixture(scope="module")
def compared(meshes) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    """Gradients and central differences of each group, for a concave object and a convex one whose shadows overlap."""
    rotation, translation_m = draw_scene(NUM_CODES, 1)
    noise = torch.Generator().manual_seed(9)
    codes = {
        "rotation": rotation,
        "translation_m": translation_m,
        "light": LIGHT + 0.1 * torch.randn(NUM_CODES, 3, generator=noise),
        "confidence": 0.5 + 0.4 * torch.rand(NUM_CODES, 2, generator=noise),
    }
    zeros = {name: torch.zeros_like(codes[name]) for name in ("translation_m", "light", "confidence")}
    zeros[TURN] = torch.zeros_like(translation_m)
    steps = {"translation_m": 0.01, "light": 0.08, TURN: 0.3, "confidence": 0.05}
    moved = {name: step * torch.randn(zeros[name].shape, generator=noise) for name, step in steps.items()}
    kinds = [meshes["root"], meshes["pebble"]]
    renderers = {
        samples: Renderer(kinds, [0, 1], SIZE, SIZE, ambient=0.3, samples_per_pixel=samples)
        for samples in (4, SAMPLES_OF_CONFIDENCE, SAMPLES_OF_SHIFTS, SAMPLES_OF_TURN)
    }
    with torch.no_grad():
        target = displaced(renderers[SAMPLES_OF_TURN], codes, None, 1)({**zeros, **moved})
    found = gradients(displaced(renderers[4], codes, target, 2), zeros)
    expected = {}
    for samples, names in (
        (SAMPLES_OF_CONFIDENCE, ["confidence"]),
        (SAMPLES_OF_SHIFTS, ["translation_m", "light"]),
        (SAMPLES_OF_TURN, [TURN]),
    ):
        expected |= central_differences(displaced(renderers[samples], codes, target, 3), zeros, names)
    return {name: (found[name], expected[name]) for name in zeros}


@pytest.mark.parametrize("group", [TURN, "translation_m", "light", "confidence"])
def test_gradient_equals_central_differences(compared, group: str) -> None:
    found, expected = compared[group]
    assert torch.isfinite(found).all()
    assert cosine(found, expected) >= 0.99
    assert float((found * expected).sum() / expected.square().sum()) == pytest.approx(1, abs=0.05)


def test_background_has_a_gradient(pebbles) -> None:
    """An image is linear in its background, so differences are exact."""
    rotation, translation_m = draw_scene(4, 2)
    behind = torch.rand(4, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(0), requires_grad=True)
    step, adjoint = torch.rand(2, 4, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(1))
    confidence = torch.full((4, 2), 0.7)

    def render(backgrounds: torch.Tensor) -> torch.Tensor:
        return pebbles(
            rotation,
            translation_m,
            camera_matrix=MATRIX,
            backgrounds=backgrounds,
            light=LIGHT.expand(4, 3),
            confidence=confidence,
        )

    render(behind).backward(adjoint)
    with torch.no_grad():
        difference = ((render(behind + step) - render(behind)) * adjoint).sum()
    assert float((behind.grad * step).sum()) == pytest.approx(float(difference), rel=1e-3)


def test_confidence_attenuates_a_shadow_like_its_object(pebbles) -> None:
    rotation, translation_m = draw_scene(4, 3)
    full = our_shadow(pebbles, rotation, translation_m, confidence=torch.tensor([[1.0, 0.0]]).expand(4, 2))
    half = our_shadow(pebbles, rotation, translation_m, confidence=torch.tensor([[0.5, 0.0]]).expand(4, 2))
    assert full.max() == 1
    assert torch.allclose(half, full / 2, atol=1e-5)


@pytest.mark.parametrize(
    "light",
    [[0.0, 0.7, 0.5], [0.0, 0.0, 0.0], (np.cross(UP, [1, 0, 0]) / 2).tolist()],
    ids=["from below", "none", "from the horizon"],
)
def test_light_that_throws_no_shadow(pebbles, light: list[float]) -> None:
    rotation, translation_m = draw_scene(4, 4)
    code = [v.requires_grad_() for v in (rotation, translation_m, torch.tensor([light]).repeat(4, 1))]
    shadow = our_shadow(pebbles, code[0], code[1], light=code[2])
    assert not shadow.any()
    shadow.backward(torch.ones_like(shadow))
    assert not any(v.grad.any() for v in code)


def test_odd_places_have_finite_gradients(pebbles) -> None:
    """Below the ground, cut by it, behind the camera, and with the horizon across the image."""
    rotation, translation_m = draw_scene(4, 5)
    translation_m[:, 0] = torch.tensor([[0, 0.5, 0.4], [0, 0.12, 0.31], [0, -0.2, -0.5], [0, 0, 0.02]])
    ground = replace(GROUND, up=np.array([0.0, -1.0, 0.0]), camera_height_m=0.12)
    code = [v.requires_grad_() for v in (rotation, translation_m, LIGHT.repeat(4, 1))]
    shadow = our_shadow(pebbles, code[0], code[1], light=code[2], ground=ground)
    assert torch.isfinite(shadow).all()
    assert not shadow[:, :, :32].any(), "a shadow above the horizon"
    shadow.backward(torch.rand_like(shadow))
    assert all(torch.isfinite(v.grad).all() for v in code)
