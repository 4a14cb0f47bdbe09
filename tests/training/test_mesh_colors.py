"""Colours of scenes of several parts."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from curio_train.meshes.meshes import Mesh, load_mesh
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial

RED, GREEN, BLUE = (255, 0, 0), (0, 255, 0), (0, 0, 255)
NUM_CORNERS = 8


def painted(x: float, *colors: tuple[int, int, int]) -> trimesh.Trimesh:
    """A box at x whose corners have these colours in turn."""
    part = trimesh.creation.box((0.1, 0.1, 0.1))
    part.apply_translation([x, 0, 0])
    part.visual = ColorVisuals(part, vertex_colors=np.resize(colors, (NUM_CORNERS, 3)).astype(np.uint8))
    return part


def of_material(x: float, **fields: object) -> trimesh.Trimesh:
    """A box at x with a material."""
    part = painted(x, RED)
    uv = np.random.default_rng(0).uniform(size=(NUM_CORNERS, 2))
    part.visual = TextureVisuals(uv=uv, material=PBRMaterial(**fields))
    return part


def textured(x: float, color: tuple[int, int, int], **fields: object) -> trimesh.Trimesh:
    """A box at x with a texture of one colour."""
    image = Image.fromarray(np.full((8, 8, 3), color, np.uint8))
    return of_material(x, baseColorTexture=image, **fields)


def read_back(folder: Path, *parts: trimesh.Trimesh) -> Mesh:
    path = folder / "scene.glb"
    trimesh.Scene(parts).export(path)
    return load_mesh(path)


def colors_at(mesh: Mesh, x: float) -> list[list[int]]:
    """The colours of a box at x, those of a texture at its corners."""
    here = np.abs(mesh.vertices_m[:, 0] - x) < 0.1
    if mesh.vertex_colors_srgb is not None:
        colors = np.round(mesh.vertex_colors_srgb[here] * 255)
    else:
        assert mesh.texture is not None
        assert mesh.uv is not None
        height, width = mesh.texture.shape[:2]
        columns, rows = (mesh.uv[here] * (width, -height) + (0, height)).astype(int).T
        colors = mesh.texture[rows, columns]
    return np.unique(colors, axis=0).astype(int).tolist()


@pytest.mark.parametrize("is_first", [True, False])
@pytest.mark.parametrize("is_textured", [True, False])
def test_a_part_of_one_color_beside_a_material(tmp_path: Path, is_first: bool, is_textured: bool) -> None:
    other = textured(0, RED) if is_textured else of_material(0, baseColorFactor=[1.0, 0, 0, 1])
    parts = [painted(1, BLUE), other]
    mesh = read_back(tmp_path, *(parts if is_first else parts[::-1]))
    assert (mesh.texture is not None) == is_textured
    assert colors_at(mesh, 1) == [[0, 0, 255]]
    assert colors_at(mesh, 0) == [[255, 0, 0]]


def test_a_part_of_several_colors_beside_a_texture(tmp_path: Path) -> None:
    parts = painted(0, GREEN, BLUE), textured(1, RED), of_material(2, baseColorFactor=[0, 1.0, 0, 1])
    mesh = read_back(tmp_path, *parts)
    assert mesh.texture is None
    assert colors_at(mesh, 0) == [[0, 0, 255], [0, 255, 0]]
    assert colors_at(mesh, 1) == [[255, 0, 0]]
    assert colors_at(mesh, 2) == [[0, 255, 0]]


def test_a_part_without_a_color_beside_a_texture(tmp_path: Path) -> None:
    mesh = read_back(tmp_path, trimesh.creation.box((0.1, 0.1, 0.1)), textured(1, RED))
    assert mesh.texture is not None
    assert colors_at(mesh, 1) == [[255, 0, 0]]


def test_a_color_beside_a_texture_is_not_applied(tmp_path: Path) -> None:
    white = [1.0, 1.0, 1.0, 1.0]
    mesh = read_back(tmp_path, textured(0, RED, baseColorFactor=white), textured(1, GREEN, baseColorFactor=white))
    assert colors_at(mesh, 0) == [[255, 0, 0]]
    assert colors_at(mesh, 1) == [[0, 255, 0]]
