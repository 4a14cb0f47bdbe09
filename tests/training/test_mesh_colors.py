"""Colours of glTF files, which are in linear light, and of scenes of several parts."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from curio_train.drawing.glb import to_glb
from curio_train.drawing.pictures import SceneContext
from curio_train.drawing.scenes import Placed, Scene
from curio_train.geometry import Pose
from curio_train.meshes import shapes
from curio_train.meshes.meshes import Mesh, load_mesh
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial

RED, GREEN, BLUE = (255, 0, 0), (0, 255, 0), (0, 0, 255)
NUM_CORNERS = 8
MIDDLE = 0.214  # in linear light, of what is half in sRGB


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


def test_colors_of_gltf_are_linear(tmp_path: Path) -> None:
    of_corners = read_back(tmp_path, painted(0, (55, 255, 0)))
    assert colors_at(of_corners, 0) == [[128, 255, 0]]  # 55 / 255 is 0.2157
    assert colors_at(read_back(tmp_path, of_material(0, baseColorFactor=[MIDDLE, 1.0, 0, 1])), 0) == [[128, 255, 0]]
    assert colors_at(read_back(tmp_path, textured(0, (55, 255, 0))), 0) == [[55, 255, 0]]  # textures are in sRGB


def test_colors_of_gltf_are_linear_beside_textures(tmp_path: Path) -> None:
    mesh = read_back(tmp_path, of_material(0, baseColorFactor=[MIDDLE, 1.0, 0, 1]), textured(1, (55, 255, 0)))
    assert mesh.texture is not None
    assert colors_at(mesh, 0) == [[128, 255, 0]]
    assert colors_at(mesh, 1) == [[55, 255, 0]]


@pytest.mark.parametrize(("component", "kind", "largest"), [(5121, "<u1", 255), (5123, "<u2", 65535), (5126, "<f4", 1)])
@pytest.mark.parametrize("factor", [None, 0.5])
def test_colors_of_corners_of_every_type(
    tmp_path: Path, component: int, kind: str, largest: int, factor: float | None
) -> None:
    part = trimesh.creation.box((0.1, 0.1, 0.1))
    if factor is not None:
        part = of_material(0, baseColorFactor=[factor, factor, factor, 1.0])
    files = trimesh.exchange.gltf.export_gltf(trimesh.Scene(part))
    tree = json.loads(files.pop("model.gltf"))
    stored = np.full((NUM_CORNERS, 4), MIDDLE * largest)
    files["colors.bin"] = (stored if largest == 1 else stored.round()).astype(kind).tobytes()
    size = len(files["colors.bin"])
    tree["buffers"].append({"uri": "colors.bin", "byteLength": size})
    tree["bufferViews"].append({"buffer": len(tree["buffers"]) - 1, "byteLength": size})
    accessor = {"componentType": component, "normalized": largest > 1, "count": NUM_CORNERS, "type": "VEC4"}
    tree["accessors"].append({**accessor, "bufferView": len(tree["bufferViews"]) - 1})
    tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = len(tree["accessors"]) - 1
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "part.gltf").write_text(json.dumps(tree))
    colors = load_mesh(tmp_path / "part.gltf").vertex_colors_srgb
    assert colors is not None
    expected = 0.5 if factor is None else 0.362  # that of half the light
    assert colors == pytest.approx(np.full((NUM_CORNERS, 3), expected), abs=1.5 / 255)


def test_colors_of_a_drawn_scene_come_back(tmp_path: Path) -> None:
    colors = np.random.default_rng(0).uniform(0.1, 1, (NUM_CORNERS, 3))
    box = shapes.box((0.1, 0.1, 0.1))
    mesh = Mesh(box.vertices_m, box.faces, colors)
    placed = Placed("box", Pose(np.eye(3), np.array([0, 0, 0.5])), (1.0, 1.0, 1.0), 1.0)
    matrix = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
    scene = Scene("frame", 640, 480, matrix, (placed,), np.array([0.0, 0, -1]))
    path = tmp_path / "drawn.glb"
    path.write_bytes(to_glb(scene, SceneContext({"box": mesh})))
    assert load_mesh(path).vertex_colors_srgb == pytest.approx(colors, abs=4 / 255)  # 256 steps are coarse in the dark
    plain = Placed("box", placed.pose, (0.5, 0.2, 0.8), 1.0)
    path.write_bytes(to_glb(Scene("frame", 640, 480, matrix, (plain,), scene.light), SceneContext({"box": box})))
    back = load_mesh(path).vertex_colors_srgb
    assert back == pytest.approx(np.tile(plain.color_srgb, (NUM_CORNERS, 1)), abs=2 / 255)
