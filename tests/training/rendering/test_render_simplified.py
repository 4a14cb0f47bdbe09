"""Meshes with many more faces than an image has pixels are traced simplified: same images, same gradients."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from curio_train.meshes.meshes import Mesh
from curio_train.meshes.simplification import simplified
from curio_train.rendering import renderer as renderer_module
from curio_train.rendering.renderer import MIN_FACES, Renderer
from stock.gradient_check import TURN, cosine, gradients, turned
from torch import Tensor

Moved = dict[str, Tensor]


def rendering(mesh: Mesh, codes: Any, matrix: np.ndarray) -> Callable[[Moved, int], Tensor]:
    """From displacements of the codes and a seed to images; objects fill most of them."""
    size = codes.backgrounds.shape[-1]
    renderer = Renderer([mesh], [0], size, size, ambient=0.3)

    def render(moved: Moved, seed: int) -> Tensor:
        return renderer(
            turned(codes.rotation, moved[TURN]),
            codes.translation_m * torch.tensor([1, 1, 0.7]) + moved["translation_m"],
            camera_matrix=matrix,
            backgrounds=codes.backgrounds,
            light=codes.light + moved["light"],
            seed=seed,
        )

    return render


@pytest.fixture(scope="module")
def simpler_meshes(fine_meshes) -> dict[str, Mesh]:
    return {name: simplified(mesh, MIN_FACES) for name, mesh in fine_meshes.items()}


@pytest.mark.parametrize("name", ["root", "ring"])
def test_fine_mesh_looks_and_pulls_as_it_does_in_full(
    fine_meshes, name: str, draw, camera_matrix, monkeypatch: pytest.MonkeyPatch
) -> None:
    codes = draw(64, 1, 3)
    render = rendering(fine_meshes[name], codes, camera_matrix)
    monkeypatch.setattr(renderer_module, "MIN_FACES", len(fine_meshes[name].faces))
    render_full = rendering(fine_meshes[name], codes, camera_matrix)
    zeros = {TURN: torch.zeros(64, 1, 3), "translation_m": torch.zeros(64, 1, 3), "light": torch.zeros(64, 3)}
    full, other_samples, found = render_full(zeros, 0), render_full(zeros, 1), render(zeros, 0)
    assert not torch.equal(found, full)  # it was simplified
    assert float((found - full).abs().mean()) < 1e-3
    assert float((found - full).square().mean()) < float((other_samples - full).square().mean())
    target = full.roll((2, 3), dims=(2, 3))
    pulls = [
        gradients(lambda m, r=r: (r(m, 0) - target).square().flatten(1).sum(1), zeros) for r in (render, render_full)
    ]
    for group in zeros:
        assert cosine(pulls[0][group], pulls[1][group]) >= 0.985


def test_small_meshes_are_untouched(meshes) -> None:
    for mesh in meshes.values():
        assert simplified(mesh, MIN_FACES) is mesh


@pytest.mark.parametrize("name", ["root", "ring"])
def test_a_simplified_mesh_keeps_shape_and_name(fine_meshes, simpler_meshes, name: str) -> None:
    mesh, simpler = fine_meshes[name], simpler_meshes[name]
    assert len(simpler.faces) == pytest.approx(MIN_FACES, rel=0.01)
    assert simpler.sha256 == mesh.sha256
    assert simpler.diameter_m == pytest.approx(mesh.diameter_m, rel=2e-3)
    assert (simpler.uv is None) == (mesh.uv is None)


def test_colors_are_those_of_the_nearest_points(simpler_meshes) -> None:
    simpler = simpler_meshes["root"]
    expected = 0.5 + 0.4 * np.sin(40 * simpler.vertices_m + [0, 1, 2])
    np.testing.assert_allclose(simpler.vertex_colors_srgb, expected, atol=1e-3)


def test_simplifying_little_loses_nothing(fine_meshes) -> None:
    """Half a pixel is little here: nearest points have to be exact for it."""
    assert len(simplified(fine_meshes["root"], 150_000).faces) == pytest.approx(150_000, rel=0.01)


def test_texture_is_not_smeared_across_a_seam(simpler_meshes) -> None:
    """No face spans the texture from one side to the other, as it would with both sides of a seam in its corners."""
    simpler = simpler_meshes["ring"]
    assert simpler.uv is not None
    assert float(np.ptp(simpler.uv[simpler.faces], axis=1).max()) < 0.2


def test_loose_leaves_are_not_simplified_away() -> None:
    rng = np.random.default_rng(0)
    corners = rng.uniform(-0.05, 0.05, (40_000, 1, 3)) + rng.normal(size=(40_000, 3, 3)) * 3e-4
    leaves = Mesh(corners.reshape(-1, 3), np.arange(120_000).reshape(-1, 3))
    assert simplified(leaves, MIN_FACES) is leaves


def test_broken_fine_meshes_are_simplified(fine_meshes) -> None:
    """Half of it turned over, faces twice or without area, a hole, every corner a vertex of its own."""
    whole = fine_meshes["root"]
    faces = whole.faces.copy()
    faces[::2] = faces[::2, ::-1]
    faces = np.concatenate([faces[:-2000], faces[:1000], np.zeros((5000, 3), dtype=np.int64)])
    broken = Mesh(whole.vertices_m[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3))
    simpler = simplified(broken, MIN_FACES)
    assert len(simpler.faces) < 1.05 * MIN_FACES
    assert np.isfinite(simpler.vertices_m).all()
    assert simpler.diameter_m == pytest.approx(whole.diameter_m, rel=2e-3)
