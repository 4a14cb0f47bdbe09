"""Gradients equal central differences of a converged rendering, at the samples that training uses."""

import functools
from collections.abc import Callable

import numpy as np
import pytest
import torch
from curio_train.meshes.meshes import Mesh
from curio_train.rendering.renderer import Renderer
from stock.gradient_check import TURN, central_differences, cosine, gradients, turned
from torch import Tensor

NUM_CODES = 64
SCENES = {"smooth": ["root"], "textured": ["ring"], "folded": ["box"], "overlapping": ["root", "box"]}
MOVING = {TURN: 0.3, "translation_m": 0.01}
"""Groups that move outlines, and how far the codes are from their targets."""

SMOOTH = ["color", "confidence", "light"]
SAMPLES_OF_MOVING, SAMPLES_OF_SMOOTH = 100, 16
"""Of the converged renderings: differences of what doesn't move are nearly free of noise."""


def edge_on(mesh: Mesh, rotation: np.ndarray, translation_m: np.ndarray) -> bool:
    """Whether a flat face is seen nearly from its side: as it turns into view the loss has a kink, not a derivative."""
    corners = mesh.vertices_m[mesh.faces] @ rotation.T + translation_m
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cosine = (normals * corners[:, 0]).sum(1) / np.linalg.norm(normals, axis=1) / np.linalg.norm(corners[:, 0], axis=1)
    return bool((np.abs(cosine) < 0.03).any())


def losses(
    renderer: Renderer, *, codes, camera_matrix: np.ndarray, seed: int, target: Tensor | None = None
) -> Callable[[dict[str, Tensor]], Tensor]:
    """From displacements of the codes to the squared error of each image; without target to the images."""

    def loss(moved: dict[str, Tensor]) -> Tensor:
        images = renderer(
            turned(codes.rotation, moved[TURN]),
            codes.translation_m + moved["translation_m"],
            camera_matrix=camera_matrix,
            backgrounds=codes.backgrounds,
            light=codes.light + moved["light"],
            color=codes.color + moved["color"],
            confidence=codes.confidence + moved["confidence"],
            seed=seed,
        )
        return images if target is None else (images - target).square().flatten(1).sum(1)

    return loss


@pytest.fixture(scope="module")
def compare(meshes, draw, camera_matrix) -> Callable[[str], dict[str, tuple[Tensor, Tensor]]]:
    """From a scene's name to each group's gradients and central differences, [codes, n] each."""

    @functools.cache
    def comparison(scene: str) -> dict[str, tuple[Tensor, Tensor]]:
        kinds = [meshes[name] for name in SCENES[scene]]
        slots = list(range(len(kinds)))
        codes = draw(NUM_CODES, len(kinds), 5)
        if "box" in SCENES[scene]:
            codes = without_kinks(codes, kinds, draw)
        size = codes.backgrounds.shape[-1]
        renderers = {
            samples: Renderer(kinds, slots, size, size, ambient=0.3, samples_per_pixel=samples)
            for samples in (4, SAMPLES_OF_SMOOTH, SAMPLES_OF_MOVING)
        }
        loss = functools.partial(losses, codes=codes, camera_matrix=camera_matrix)
        zeros = {name: torch.zeros_like(getattr(codes, name)) for name in SMOOTH}
        zeros |= {name: torch.zeros_like(codes.translation_m) for name in MOVING}
        with torch.no_grad():
            noise = torch.Generator().manual_seed(9)
            moved = {name: step * torch.randn(zeros[name].shape, generator=noise) for name, step in MOVING.items()}
            target = loss(renderers[SAMPLES_OF_SMOOTH], seed=1)({**zeros, **moved})
        found = gradients(loss(renderers[4], target=target, seed=2), zeros)
        expected = {}
        for samples, names in ((SAMPLES_OF_SMOOTH, SMOOTH), (SAMPLES_OF_MOVING, list(MOVING))):
            expected |= central_differences(loss(renderers[samples], target=target, seed=3), zeros, names)
        return {name: (found[name], expected[name]) for name in zeros}

    return comparison


def without_kinks(codes, kinds, draw):
    """Replace codes in which a box is seen edge-on by others."""
    reserve = draw(4 * NUM_CODES, len(kinds), 6)
    box = len(kinds) - 1
    pose = lambda c, i: (c.rotation[i, box].double().numpy(), c.translation_m[i, box].double().numpy())  # noqa: E731
    good = iter([i for i in range(4 * NUM_CODES) if not edge_on(kinds[box], *pose(reserve, i))])
    for i in range(NUM_CODES):
        if edge_on(kinds[box], *pose(codes, i)):
            j = next(good)
            codes.rotation[i, box] = reserve.rotation[j, box]
            codes.translation_m[i] = reserve.translation_m[j]
    return codes


@pytest.mark.parametrize("group", [*MOVING, *SMOOTH])
@pytest.mark.parametrize("scene", SCENES)
def test_gradient_equals_central_differences(compare, scene: str, group: str) -> None:
    found, expected = compare(scene)[group]
    assert torch.isfinite(found).all()
    assert cosine(found, expected) >= 0.99
    slope = float((found * expected).sum() / expected.square().sum())
    assert slope == pytest.approx(1, abs=0.05)
