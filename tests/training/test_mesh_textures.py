"""Textures that lie beside a mesh are found however its file writes their names, and missed aloud."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from curio_train.errors import MeshError
from curio_train.meshes.meshes import load_mesh
from PIL import Image

RED = (255, 0, 0)
TRIANGLE = "usemtl skin\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"


def textured(folder: Path, *written: str, library: str = "part.mtl") -> Path:
    """An OBJ file whose materials have these lines, beside textures ``red.png`` and ``textures/my red.png``."""
    image = Image.fromarray(np.full((4, 4, 3), RED, np.uint8))
    (folder / "textures").mkdir()
    image.save(folder / "red.png")
    image.save(folder / "textures" / "my red.png")
    (folder / "part.mtl").write_text("\n".join(["newmtl skin", "Kd 1 1 1", *written]) + "\n")
    path = folder / "part.obj"
    path.write_text(f"mtllib {library}\n{TRIANGLE}")
    return path


@pytest.mark.parametrize(
    "name",
    [
        "red.png",
        "textures/my red.png",
        "textures\\my red.png",
        ".\\red.png",
        "C:\\Users\\me\\red.png",
        "/elsewhere/red.png",
        "../elsewhere/red.png",
        "RED.PNG",
        "Textures\\My Red.png",
        "-s 1 1 1 red.png",
        "-clamp on -bm 0.5 -o 0.0 1e-3 0 textures/my red.png",
        '"red.png"',
    ],
)
def test_textures_are_found(tmp_path: Path, name: str) -> None:
    mesh = load_mesh(textured(tmp_path, f"map_Kd {name}"))
    assert mesh.texture is not None
    assert np.unique(mesh.texture.reshape(-1, 3), axis=0).tolist() == [[*RED]]


@pytest.mark.parametrize("name", ["gone.png", "C:\\Users\\me\\gone.png", "-s 1 1 1 gone.png", "textures"])
def test_a_missing_texture_is_refused(tmp_path: Path, name: str) -> None:
    path = textured(tmp_path, f"map_Kd {name}")
    with pytest.raises(MeshError) as caught:
        load_mesh(path)
    for text in (str(path), name, "beside the mesh", "MTL"):
        assert text in str(caught.value)


def test_what_is_no_image_is_refused(tmp_path: Path) -> None:
    path = textured(tmp_path, "map_Kd red.png")
    (tmp_path / "red.png").write_text("version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(MeshError, match=r"red\.png cannot be read \(it is no image"):
        load_mesh(path)


@pytest.mark.parametrize("library", ["PART.MTL", ".\\part.mtl"])
def test_materials_are_found(tmp_path: Path, library: str) -> None:
    mesh = load_mesh(textured(tmp_path, "map_Kd red.png", library=library))
    assert mesh.texture is not None
    assert mesh.texture[0, 0].tolist() == [*RED]


def test_texture_coordinates_without_materials_are_no_color(tmp_path: Path) -> None:
    mesh = load_mesh(textured(tmp_path, "map_Kd red.png", library="gone.mtl"))
    assert mesh.texture is None
    assert mesh.vertex_colors_srgb is None


def write_gltf(folder: Path) -> Path:
    """A glTF file with a texture and buffers beside it."""
    part = trimesh.creation.box((0.1, 0.1, 0.1))
    image = Image.fromarray(np.full((4, 4, 3), RED, np.uint8))
    part.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), image=image)
    for name, content in trimesh.exchange.gltf.export_gltf(trimesh.Scene(part)).items():
        (folder / name).write_bytes(content)
    image.save(folder / "red.png")
    path = folder / "model.gltf"
    tree = json.loads(path.read_text())
    tree["images"] = [{"uri": "red.png"}]
    path.write_text(json.dumps(tree))
    return path


def test_a_missing_texture_of_gltf_is_refused(tmp_path: Path) -> None:
    path = write_gltf(tmp_path)
    assert load_mesh(path).texture is not None
    (tmp_path / "red.png").unlink()
    with pytest.raises(MeshError, match=r"red\.png cannot be read \(there is no such file\)"):
        load_mesh(path)


def test_names_in_gltf_are_quoted(tmp_path: Path) -> None:
    path = write_gltf(tmp_path)
    tree = json.loads(path.read_text())
    for named in (*tree["buffers"], *tree["images"]):
        (tmp_path / named["uri"]).rename(tmp_path / f"my ä {named['uri']}")
        named["uri"] = f"my%20%C3%A4%20{named['uri']}"
    path.write_text(json.dumps(tree))
    mesh = load_mesh(path)
    assert mesh.faces.shape == (12, 3)
    assert mesh.texture is not None
