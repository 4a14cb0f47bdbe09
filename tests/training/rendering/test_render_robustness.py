"""No pose and no mesh makes a NaN; what cannot be seen has no gradient; batches may be split and repeated."""

from typing import Any

import numpy as np
import pytest
import torch
from curio_train.errors import RendererError
from curio_train.meshes.meshes import Mesh
from curio_train.rendering import renderer as renderer_module
from curio_train.rendering.renderer import Renderer

SIZE = 64
LEAVES = ("rotation", "translation_m", "color", "confidence", "light")


def render(renderer: Renderer, codes: Any, matrix: np.ndarray, seed: int = 0) -> tuple[torch.Tensor, dict]:
    """The images, and the leaves that they can be differentiated by."""
    leaves = {name: getattr(codes, name).clone().requires_grad_() for name in LEAVES}
    more = {name: leaves[name] for name in ("color", "confidence", "light")}
    images = renderer(
        leaves["rotation"],
        leaves["translation_m"],
        camera_matrix=matrix,
        backgrounds=codes.backgrounds,
        seed=seed,
        **more,
    )
    return images, leaves


def gradients(images: torch.Tensor, leaves: dict) -> dict[str, torch.Tensor]:
    """Of a sum that no symmetry makes vanish."""
    weights = torch.linspace(-1, 1, images.numel()).view(images.shape)
    (images * weights).sum().backward()
    return {name: leaf.grad for name, leaf in leaves.items()}


@pytest.mark.parametrize(
    "place",
    [[0, 0, -0.4], [0, 0, -0.02], [5, 0, 0.4], [0, -5, 0.4], [0, 0, 1e9], [0, 0, -1e9]],
    ids=["behind", "just behind", "beside", "above", "far away", "far behind"],
)
def test_what_cannot_be_seen_has_no_gradient(meshes, draw, camera_matrix, place: list[float]) -> None:
    codes = draw(4, 1, 1)
    codes.translation_m[:] = torch.tensor(place)
    if place == [0, 0, -0.02]:
        codes.translation_m[:, :, 2] = -0.2  # the object ends 0.12 m behind the camera at most
    images, leaves = render(Renderer([meshes["root"]], [0], SIZE, SIZE, ambient=0.3), codes, camera_matrix)
    if abs(place[2]) < 1e8 or place[2] < 0:
        assert torch.equal(images, codes.backgrounds)
    for name, gradient in gradients(images, leaves).items():
        assert torch.isfinite(gradient).all(), name
        if torch.equal(images, codes.backgrounds):
            assert not gradient.any(), name


@pytest.mark.parametrize("depth_m", [0.0, 0.03, 0.06], ids=["camera in the centre", "inside", "at the surface"])
def test_camera_inside_the_object_is_harmless(meshes, draw, camera_matrix, depth_m: float) -> None:
    codes = draw(8, 1, 1)
    codes.translation_m[:] = torch.tensor([0, 0, depth_m])
    images, leaves = render(Renderer([meshes["root"]], [0], SIZE, SIZE, ambient=0.3), codes, camera_matrix)
    assert torch.isfinite(images).all()
    for name, gradient in gradients(images, leaves).items():
        assert torch.isfinite(gradient).all(), name


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_code_that_is_no_number_leaves_the_others_alone(meshes, draw, camera_matrix, bad: float) -> None:
    codes = draw(8, 1, 1)
    renderer = Renderer([meshes["root"]], [0], SIZE, SIZE, ambient=0.3)
    expected, _ = render(renderer, codes, camera_matrix)
    codes.translation_m[3] = bad
    images, leaves = render(renderer, codes, camera_matrix)
    others = [0, 1, 2, 4, 5, 6, 7]
    assert torch.equal(images[3], codes.backgrounds[3])
    assert torch.allclose(images[others], expected[others], atol=1e-5)
    gradient = gradients(images, leaves)["translation_m"][others]
    assert torch.isfinite(gradient).all()
    assert gradient.any()


def degenerate_meshes() -> dict[str, Mesh]:
    corners = np.array([[x, y, z] for x in (-0.03, 0.03) for y in (-0.03, 0.03) for z in (-0.03, 0.03)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))])
    turned = faces.copy()
    turned[::3] = turned[::3, ::-1]
    middle = np.vstack([corners, corners[:1] / 2 + corners[1:2] / 2])
    return {
        "zero-area faces": Mesh(middle, np.vstack([faces, [[0, 0, 1], [2, 2, 2], [0, 8, 1]]])),
        "duplicate vertices": Mesh(corners[faces].reshape(-1, 3), np.arange(36).reshape(-1, 3)),
        "open": Mesh(corners, faces[2:]),
        "inconsistent winding": Mesh(corners, turned),
        "inside out": Mesh(corners, faces[:, ::-1]),
        "three faces at an edge": Mesh(corners, np.vstack([faces, [[0, 1, 7]]])),
        "every face twice": Mesh(corners, np.vstack([faces, faces])),
        "flat": Mesh(corners[:4] * [0, 1, 1], np.array([[0, 1, 3], [0, 3, 2]])),
        "a single triangle": Mesh(corners[:3], np.array([[0, 1, 2]])),
    }


@pytest.mark.parametrize("name", degenerate_meshes())
def test_degenerate_meshes_render_and_differentiate(name: str, draw, camera_matrix) -> None:
    codes = draw(16, 1, 4)
    images, leaves = render(Renderer([degenerate_meshes()[name]], [0], SIZE, SIZE, ambient=0.3), codes, camera_matrix)
    assert torch.isfinite(images).all()
    assert (images != codes.backgrounds).any()
    for leaf, gradient in gradients(images, leaves).items():
        assert torch.isfinite(gradient).all(), leaf
        assert gradient.any(), leaf


@pytest.mark.parametrize("name", ["inside out", "duplicate vertices", "inconsistent winding"])
def test_a_box_is_a_box_however_it_is_stored(name: str, draw, camera_matrix) -> None:
    codes = draw(16, 1, 4)
    corners = degenerate_meshes()["open"].vertices_m
    whole = degenerate_meshes()["every face twice"]
    box = Mesh(corners, whole.faces[: len(whole.faces) // 2])
    found = [
        render(Renderer([mesh], [0], SIZE, SIZE, ambient=0.3), codes, camera_matrix)
        for mesh in (box, degenerate_meshes()[name])
    ]
    assert torch.allclose(found[0][0], found[1][0], atol=1e-4)
    expected, gradient = (gradients(*pair)["translation_m"] for pair in found)
    assert torch.nn.functional.cosine_similarity(expected.flatten(), gradient.flatten(), dim=0) > 0.99


@pytest.mark.parametrize("slots", [1, 2])
def test_a_split_batch_gives_the_same(meshes, draw, camera_matrix, monkeypatch, slots: int) -> None:
    codes = draw(12, slots, 8)
    renderer = Renderer([meshes["root"], meshes["box"]], list(range(slots)), SIZE, SIZE, ambient=0.3)
    images, leaves = render(renderer, codes, camera_matrix, seed=3)
    whole = gradients(images, leaves)
    monkeypatch.setattr(renderer_module, "MAX_RAYS", 20_000)
    split_images, split_leaves = render(renderer, codes, camera_matrix, seed=3)
    assert torch.allclose(images, split_images, atol=1e-5)
    for name, gradient in gradients(split_images, split_leaves).items():
        scale = whole[name].abs().max()
        assert torch.allclose(gradient, whole[name], atol=1e-4 * float(scale)), name


def test_the_seed_decides_the_samples(meshes, draw, camera_matrix) -> None:
    codes = draw(4, 1, 8)
    renderer = Renderer([meshes["root"]], [0], SIZE, SIZE, ambient=0.3)
    first, again, other = (render(renderer, codes, camera_matrix, seed)[0] for seed in (1, 1, 2))
    assert torch.allclose(first, again, atol=1e-6)
    assert not torch.allclose(first, other, atol=1e-3)


def test_inputs_are_left_as_they_were(meshes, draw, camera_matrix) -> None:
    codes = draw(4, 1, 8)
    before = codes.backgrounds.clone()
    images, leaves = render(Renderer([meshes["root"]], [0], SIZE, SIZE, ambient=0.3), codes, camera_matrix)
    gradients(images, leaves)
    with torch.no_grad():
        images.zero_()
    assert torch.equal(codes.backgrounds, before)


def test_wrong_calls_are_refused(meshes, draw, camera_matrix) -> None:
    codes = draw(4, 1, 8)
    renderer = Renderer([meshes["box"]], [0], SIZE, SIZE, ambient=0.3)
    skewed = camera_matrix.copy()
    skewed[0, 1] = 3
    with pytest.raises(RendererError, match="skew"):
        render(renderer, codes, skewed)
    with pytest.raises(RendererError, match="2 slots"):
        render(Renderer([meshes["box"]], [0, 0], SIZE, SIZE, ambient=0.3), codes, camera_matrix)
    with pytest.raises(RendererError, match="kind_of_slot"):
        Renderer([meshes["box"]], [1], SIZE, SIZE, ambient=0.3)
    with pytest.raises(RendererError, match="extent"):
        Renderer([Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]]))], [0], SIZE, SIZE, ambient=0.3)
    line = np.array([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]])
    with pytest.raises(RendererError, match="no face with an area"):
        Renderer([Mesh(line, np.array([[0, 1, 2]]))], [0], SIZE, SIZE, ambient=0.3)
    with pytest.raises(RendererError, match="no mesh"):
        Renderer([], [], SIZE, SIZE, ambient=0.3)
