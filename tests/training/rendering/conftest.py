"""Meshes, cameras and poses that the renderer's tests share."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from curio_train.meshes.meshes import Mesh
from curio_train.rendering.variant import load_mitsuba
from scipy.spatial.transform import Rotation
from torch import Tensor

SIZE = 64
CAMERA_MATRIX = np.array([[84.0, 0, 30.5], [0, 86.0, 33.0], [0, 0, 1]])
"""Of images 64 x 64; neither square pixels nor a centred principal point."""


def _colors(vertices: np.ndarray) -> np.ndarray:
    return 0.5 + 0.4 * np.sin(40 * vertices + np.array([0, 1, 2]))


def _sphere(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    shape = trimesh.creation.icosphere(subdivisions=subdivisions)
    return np.asarray(shape.vertices), np.asarray(shape.faces)


def _pebble() -> Mesh:
    """Convex, smooth, with vertex colours."""
    directions, faces = _sphere(4)
    vertices = directions * [0.05, 0.04, 0.03]
    return Mesh(vertices, faces, _colors(vertices))


def _root(subdivisions: int) -> Mesh:
    """Concave and without symmetry, smooth, with vertex colours."""
    directions, faces = _sphere(subdivisions)
    x, y, z = directions.T[:, :, None]
    vertices = 0.05 * directions * (1 + 0.3 * np.sin(3 * x) * np.cos(4 * y) + 0.2 * z)
    return Mesh(vertices, faces, _colors(vertices))


def _ring(around: int, across: int) -> Mesh:
    """A torus with a texture that is different everywhere."""
    u, v = np.meshgrid(np.arange(around + 1) / around, np.arange(across + 1) / across, indexing="ij")
    a, b = 2 * np.pi * u, 2 * np.pi * v
    reach = 0.035 + 0.015 * np.cos(b)
    vertices = np.stack([reach * np.cos(a), reach * np.sin(a), 0.015 * np.sin(b)], axis=-1).reshape(-1, 3)
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(around), np.arange(across), indexing="ij"))
    corner = i * (across + 1) + j
    beside, above = corner + across + 1, corner + 1
    faces = np.concatenate([np.c_[corner, beside, beside + 1], np.c_[corner, beside + 1, above]])
    y, x = np.mgrid[0:64, 0:64] / 64
    waves = np.stack([np.sin(6 * np.pi * x), np.cos(4 * np.pi * y), np.sin(2 * np.pi * (x + y))], axis=-1)
    texture = ((0.5 + 0.4 * waves) * 255).astype(np.uint8)
    return Mesh(vertices, faces, uv=np.c_[u.ravel(), v.ravel()], texture=texture)


def _box() -> Mesh:
    """Folds and nothing else; no colour of its own."""
    shape = trimesh.creation.box(extents=(0.06, 0.05, 0.07))
    return Mesh(np.asarray(shape.vertices), np.asarray(shape.faces))


@pytest.fixture(scope="session")
def meshes() -> dict[str, Mesh]:
    """The test objects, about a decimetre across: pebble, root, ring and box."""
    return {"pebble": _pebble(), "root": _root(3), "ring": _ring(48, 24), "box": _box()}


@pytest.fixture(scope="session")
def fine_meshes() -> dict[str, Mesh]:
    """The root with 327,680 faces and the ring with 120,000."""
    return {"root": _root(7), "ring": _ring(300, 200)}


@pytest.fixture(scope="session")
def mitsuba() -> Any:
    """Mitsuba as the renderer loads it."""
    return load_mitsuba()


@pytest.fixture(scope="session")
def camera_matrix() -> np.ndarray:
    """K of the 64 x 64 images."""
    return CAMERA_MATRIX


@dataclass(frozen=True)
class Codes:
    """Random scene codes for one or two slots.

    Attributes:
        rotation: [batch, slots, 3, 3].
        translation_m: [batch, slots, 3].
        color: [batch, slots, 3].
        confidence: [batch, slots].
        light: [batch, 3].
        backgrounds: [batch, 3, 64, 64], each of one colour.
    """

    rotation: Tensor
    translation_m: Tensor
    color: Tensor
    confidence: Tensor
    light: Tensor
    backgrounds: Tensor


def _draw(count: int, num_slots: int, seed: int) -> Codes:
    """Objects near the middle, each slot further away; in a quarter of the codes the first is half out of frame."""
    rng = np.random.default_rng(seed)
    place = rng.uniform([-0.03, -0.03, 0.24], [0.03, 0.03, 0.32], (count, num_slots, 3))
    place[:, :, 2] += 0.2 * np.arange(num_slots)
    place[: count // 4, 0, 0] = np.sign(place[: count // 4, 0, 0]) * place[: count // 4, 0, 2] * 32 / 84
    tone = rng.random((count, 3, 1, 1))
    arrays = (
        Rotation.random(count * num_slots, random_state=seed).as_matrix().reshape(count, num_slots, 3, 3),
        place,
        rng.uniform(0.3, 0.9, (count, num_slots, 3)),
        rng.uniform(0.5, 0.9, (count, num_slots)),
        rng.normal(size=(count, 3)) * [0.4, 0.4, 0.2] - [0, 0, 0.5],
        np.broadcast_to(tone, (count, 3, SIZE, SIZE)),
    )
    return Codes(*(torch.tensor(np.ascontiguousarray(a), dtype=torch.float32) for a in arrays))


@pytest.fixture(scope="session")
def draw() -> Callable[[int, int, int], Codes]:
    """From number of codes, number of slots and seed to codes."""
    return _draw
