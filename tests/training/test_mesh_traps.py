"""Mesh files that trimesh reads otherwise than they are meant, or not whole: read as meant, or refused."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from curio_train.errors import MeshError
from curio_train.meshes.meshes import load_mesh, to_ply
from curio_train.meshes.shapes import box, painted
from PIL import Image

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
RED, GREEN = (255, 0, 0), (0, 255, 0)


def gltf(change: Callable[[dict[str, Any]], object]) -> str:
    """A triangle with a texture, after a change of its description."""
    buffer = CORNERS.tobytes() + np.ascontiguousarray(CORNERS[:, :2]).tobytes()
    file = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"uri": "red.png"}],
        "buffers": [{"uri": "part.bin", "byteLength": len(buffer)}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 24}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
        ],
    }
    change(file)
    return json.dumps(file)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    buffer = CORNERS.tobytes() + np.ascontiguousarray(CORNERS[:, :2]).tobytes()
    (tmp_path / "part.bin").write_bytes(buffer)
    Image.fromarray(np.full((4, 4, 3), RED, np.uint8)).save(tmp_path / "red.png")
    return tmp_path


def texture_of(file: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = file["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    return found


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda f: f.update(extensionsRequired=["KHR_mesh_quantization"]), "the extension KHR_mesh_quantization"),
        (lambda f: f.update(extensionsRequired=["KHR_draco_mesh_compression"]), "KHR_draco_mesh_compression"),
        (lambda f: texture_of(f).update(texCoord=1), "TEXCOORD_1"),
        (lambda f: texture_of(f).update(extensions={"KHR_texture_transform": {}}), "KHR_texture_transform"),
        (lambda f: f["accessors"][1].update(componentType=5123, normalized=True), "are whole numbers"),
        (lambda f: f["accessors"][0].update(sparse={"count": 1}), r"a sparse accessor \(POSITION\)"),
    ],
)
def test_what_is_not_read_of_gltf_is_refused(
    folder: Path, change: Callable[[dict[str, Any]], object], told: str
) -> None:
    (folder / "part.gltf").write_text(gltf(change))
    with pytest.raises(MeshError, match=f"{told}.*export it without"):
        load_mesh(folder / "part.gltf")


def test_what_needs_no_reading_of_gltf_is_no_error(folder: Path) -> None:
    (folder / "part.gltf").write_text(gltf(lambda f: f.update(extensionsRequired=["KHR_materials_unlit"])))
    mesh = load_mesh(folder / "part.gltf")
    assert mesh.texture is not None
    assert mesh.diameter_m == pytest.approx(2**0.5)


@pytest.mark.parametrize("scale", [1, 255])
@pytest.mark.parametrize("kind", ["obj", "ascii", "binary_little_endian", "binary_big_endian"])
def test_colors_are_fractions(tmp_path: Path, kind: str, scale: int) -> None:
    colors = np.float32(scale) * np.array([[0.2, 0.4, 0.8]] * 3, np.float32)
    rows = np.concatenate([CORNERS, colors], axis=1)
    if kind == "obj":
        path = tmp_path / "part.obj"
        path.write_text("\n".join(f"v {' '.join(map(str, row))}" for row in rows) + "\nf 1 2 3\n")
    else:
        path = tmp_path / "part.ply"
        names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "red", "green", "blue"))
        faces = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        head = f"ply\nformat {kind} 1.0\nelement vertex 3\n{names}{faces}".encode()
        order = ">" if kind.endswith("big_endian") else "<"
        triangle = bytes([3]) + np.array([0, 1, 2], f"{order}i4").tobytes()
        text = "\n".join(" ".join(map(str, row)) for row in rows).encode() + b"\n3 0 1 2\n"
        path.write_bytes(head + (text if kind == "ascii" else rows.astype(f"{order}f4").tobytes() + triangle))
    if scale > 1:
        with pytest.raises(MeshError, match="colours up to 204, written as floating-point numbers"):
            load_mesh(path)
        return
    found = load_mesh(path).vertex_colors_srgb
    assert found is not None
    np.testing.assert_allclose(found[0], [0.2, 0.4, 0.8], atol=1 / 255)


def test_a_missing_texture_of_ply_is_refused_unless_vertices_have_colors(tmp_path: Path) -> None:
    plain, colored = box((0.1, 0.1, 0.1)), painted(box((0.1, 0.1, 0.1)), 0.5)
    for mesh, name in ((plain, "plain"), (colored, "colored")):
        content = to_ply(mesh).replace(b"1.0\n", b"1.0\ncomment TextureFile gone.png\n", 1)
        (tmp_path / f"{name}.ply").write_bytes(content)
    with pytest.raises(MeshError, match=r"its texture gone\.png cannot be read"):
        load_mesh(tmp_path / "plain.ply")
    assert load_mesh(tmp_path / "colored.ply").vertex_colors_srgb is not None


def write_two_materials(folder: Path, largest_uv: float) -> Path:
    """Two triangles, the first red and green in halves of a texture, the second red."""
    halves = np.concatenate([np.full((8, 4, 3), RED, np.uint8), np.full((8, 4, 3), GREEN, np.uint8)], axis=1)
    Image.fromarray(halves).save(folder / "halves.png")
    materials = [f"newmtl {name}\nKd 1 1 1\nmap_Kd {name}.png" for name in ("halves", "red")]
    (folder / "part.mtl").write_text("\n".join(materials) + "\n")
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 0 1 1\n"
    uv = f"vt 0.25 0.5\nvt {largest_uv} 0.5\nvt 0.25 0.9\n"
    faces = "usemtl halves\nf 1/1 2/2 3/3\nusemtl red\nf 4/1 5/1 6/1\n"
    (folder / "part.obj").write_text(f"mtllib part.mtl\n{corners}{uv}{faces}")
    return folder / "part.obj"


def test_textures_that_repeat_are_not_packed(folder: Path) -> None:
    packed = load_mesh(write_two_materials(folder, 0.75))
    assert packed.texture is not None
    repeated = load_mesh(write_two_materials(folder, 1.75))
    assert repeated.vertex_colors_srgb is not None
    found = {
        tuple(corner): tuple(color)
        for corner, color in zip(
            repeated.vertices_m.tolist(), np.round(255 * repeated.vertex_colors_srgb).astype(int).tolist(), strict=True
        )
    }
    assert found[1.0, 0.0, 0.0] == GREEN
    assert {color for corner, color in found.items() if corner != (1.0, 0.0, 0.0)} == {RED}


def test_grey_of_16_bits_is_not_clipped(folder: Path) -> None:
    Image.fromarray(np.full((4, 4), 32_896, np.uint16)).save(folder / "red.png")
    (folder / "part.gltf").write_text(gltf(lambda f: None))
    mesh = load_mesh(folder / "part.gltf")
    assert mesh.texture is not None
    assert np.unique(mesh.texture).tolist() == [128]
