"""Mesh files: units, colours, and everything that is refused."""

import hashlib
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from curio_train.errors import MeshError
from curio_train.meshes import shapes
from curio_train.meshes.extent import diameter
from curio_train.meshes.meshes import Mesh, load_mesh
from PIL import Image
from scipy.spatial.distance import pdist

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"

POINTS = (
    "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    "0 0 0\n1 1 1\n"
)


def write(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def ply(vertices: str, face: str) -> str:
    header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    return f"{header}element face 1\nproperty list uchar int vertex_indices\nend_header\n{vertices}{face}"


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".glb", ".off"])
def test_formats(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"box{suffix}"
    trimesh.creation.box((0.1, 0.2, 0.3)).export(path)
    mesh = load_mesh(path)
    assert mesh.vertices_m.shape == (8, 3)
    assert mesh.faces.shape == (12, 3)
    assert mesh.diameter_m == pytest.approx(0.14**0.5, rel=1e-6)
    assert mesh.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert np.ptp(mesh.box_corners_m, axis=0) == pytest.approx([0.1, 0.2, 0.3], rel=1e-6)


def test_corners_differ_by_bits() -> None:
    corners = shapes.box((2.0, 4.0, 6.0)).box_corners_m
    assert corners[0].tolist() == [-1, -2, -3]
    assert corners[1].tolist() == [1, -2, -3]
    assert corners[2].tolist() == [-1, 2, -3]
    assert corners[4].tolist() == [-1, -2, 3]
    assert corners[7].tolist() == [1, 2, 3]


@pytest.mark.parametrize(("unit", "metres"), [("mm", 0.001), ("cm", 0.01), ("inch", 0.0254), ("m", 1.0)])
def test_units(tmp_path: Path, unit: str, metres: float) -> None:
    mesh = load_mesh(write(tmp_path / "t.obj", "v 0 0 0\nv 4 0 0\nv 0 3 0\nf 1 2 3\n"), unit)
    assert mesh.diameter_m == pytest.approx(5 * metres)


@pytest.mark.parametrize(
    ("size", "unit", "expected"),
    [
        (100, None, ["100 m", "read as m", "--mesh-unit to cm or mm or inch"]),
        (15_000, "m", ["--mesh-unit m", "--mesh-unit to mm"]),
        (0.5, "mm", ["0.5 mm", "--mesh-unit to m or cm or inch"]),
        (1e-9, None, ["rescale"]),
        (0, None, ["1 faces have no area"]),
    ],
)
def test_impossible_sizes(tmp_path: Path, size: float, unit: str | None, expected: list[str]) -> None:
    path = write(tmp_path / "t.obj", f"v 0 0 0\nv {size} 0 0\nv {size / 2} {size / 10} 0\nf 1 2 3\n")
    with pytest.raises(MeshError) as caught:
        load_mesh(path, unit)
    for text in expected:
        assert text in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "text"),
    [
        ("empty.ply", "", "0 bytes"),
        ("mesh.txt", "x", "unknown kind of mesh '.txt'"),
        ("words.ply", "hello", "not a readable PLY"),
        ("words.obj", "hello world", "no faces"),
        ("words.stl", b"\x00\xff\xfe" * 40, "STL"),
        ("short.glb", b"glTF", "not a readable GLB"),
        ("points.obj", TRIANGLE, "found 3 vertices and no faces"),
        ("points.ply", POINTS, "found 2 vertices and no faces"),
        ("nan.obj", TRIANGLE.replace("1 0 0", "nan 0 0") + "f 1 2 3\n", "NaN or infinite"),
        ("inf.obj", TRIANGLE.replace("1 0 0", "inf 0 0") + "f 1 2 3\n", "NaN or infinite"),
        ("high.ply", ply("0 0 0\n1 0 0\n0 1 0\n", "3 0 1 9\n"), "vertex 9"),
        ("low.ply", ply("0 0 0\n1 0 0\n0 1 0\n", "3 0 1 -2\n"), "vertex -2"),
        ("high.obj", TRIANGLE + "f 1 2 9\n", "high.obj"),
    ],
)
def test_refuses(tmp_path: Path, name: str, content: str | bytes, text: str) -> None:
    path = write(tmp_path / name, content)
    with pytest.raises(MeshError) as caught:
        load_mesh(path)
    assert text in str(caught.value)
    assert str(path) in str(caught.value)


def test_missing_and_folder(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match="cannot be read"):
        load_mesh(tmp_path / "none.ply")
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(MeshError, match=r"folder\.ply: is a folder"):
        load_mesh(tmp_path / "folder.ply")


def test_sizes_that_cannot_be(tmp_path: Path) -> None:
    head = b"ply\nformat binary_little_endian 1.0\nelement vertex 1000000000000000000\nproperty float x\n"
    head += b"property float y\nproperty float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    with pytest.raises(MeshError, match="not a readable PLY"):
        load_mesh(write(tmp_path / "a.ply", head + bytes(100)))
    with (tmp_path / "b.stl").open("wb") as sparse:
        sparse.truncate(60 << 30)
    with pytest.raises(MeshError, match="at most"):
        load_mesh(tmp_path / "b.stl")


def test_pipes_are_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.ply")
    with pytest.raises(MeshError, match="not a regular file"):
        load_mesh(tmp_path / "a.ply")
    for name in ("b.mtl", "c.png"):
        os.mkfifo(tmp_path / name)
    write(tmp_path / "c.mtl", "newmtl m\nmap_Kd c.png\n")
    text = f"usemtl m\n{TRIANGLE}f 1 2 3\n"
    assert load_mesh(write(tmp_path / "b.obj", f"mtllib b.mtl\n{text}")).texture is None
    with pytest.raises(MeshError, match="not a regular file"):
        load_mesh(write(tmp_path / "c.obj", f"mtllib c.mtl\n{text}"))


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".glb"])
@pytest.mark.parametrize("kept", [0.02, 0.3, 0.9])
def test_truncated_binary(tmp_path: Path, suffix: str, kept: float) -> None:
    path = tmp_path / f"s{suffix}"
    trimesh.creation.icosphere().export(path)
    content = path.read_bytes()
    with pytest.raises(MeshError, match="complete"):
        load_mesh(write(path, content[: int(kept * len(content))]))


def test_stray_vertices_do_not_count(tmp_path: Path) -> None:
    mesh = load_mesh(write(tmp_path / "t.obj", TRIANGLE + "v 9 9 9\nf 1 2 3\n"))
    assert mesh.diameter_m == pytest.approx(2**0.5)


def test_degenerate_faces_are_kept(tmp_path: Path) -> None:
    mesh = load_mesh(write(tmp_path / "t.obj", TRIANGLE + "f 1 2 3\nf 1 1 2\n"))
    assert len(mesh.faces) == 2


def test_vertex_colors(tmp_path: Path) -> None:
    box = trimesh.creation.box()
    colors = np.random.default_rng(0).integers(0, 256, (8, 4))
    box.visual.vertex_colors = colors
    box.export(tmp_path / "t.ply")
    mesh = load_mesh(tmp_path / "t.ply")
    assert mesh.vertex_colors_srgb is not None
    np.testing.assert_allclose(mesh.vertex_colors_srgb, colors[:, :3] / 255)


def test_texture(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "skin.png")
    write(tmp_path / "t.mtl", "newmtl a\nmap_Kd skin.png\n")
    text = f"mtllib t.mtl\nusemtl a\n{TRIANGLE}vt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"
    mesh = load_mesh(write(tmp_path / "t.obj", text))
    assert mesh.texture is not None
    assert mesh.uv is not None
    assert np.array_equal(mesh.texture, pixels)
    at_corner = mesh.uv[np.flatnonzero((mesh.vertices_m == [0, 1, 0]).all(axis=1))[0]]
    assert at_corner.tolist() == [0, 1]
    assert mesh.vertex_colors_srgb is None


def test_material_color_and_none(tmp_path: Path) -> None:
    write(tmp_path / "t.mtl", "newmtl a\nKd 1 0 0\n")
    red = load_mesh(write(tmp_path / "t.obj", f"mtllib t.mtl\nusemtl a\n{TRIANGLE}vt 0 0\nf 1/1 2/1 3/1\n"))
    assert red.vertex_colors_srgb is not None
    assert np.unique(red.vertex_colors_srgb, axis=0).tolist() == [[1, 0, 0]]
    plain = load_mesh(write(tmp_path / "p.obj", TRIANGLE + "f 1 2 3\n"))
    assert plain.vertex_colors_srgb is None
    assert plain.texture is None


def test_broken_texture(tmp_path: Path) -> None:
    path = tmp_path / "skin.png"
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)).save(path)
    write(path, path.read_bytes()[:2000])
    write(tmp_path / "t.mtl", "newmtl a\nmap_Kd skin.png\n")
    text = f"mtllib t.mtl\nusemtl a\n{TRIANGLE}vt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"
    with pytest.raises(MeshError, match="texture"):
        load_mesh(write(tmp_path / "t.obj", text))


def test_diameter_is_exact() -> None:
    for seed in range(20):
        points = np.random.default_rng(seed).standard_normal((700, 3)) * [1, 2, 1 + seed % 3]
        assert diameter(points) == pytest.approx(pdist(points).max(), rel=1e-7)
    # Far points in plenty: no corner leads straight to the answer.
    for seed in range(5):
        points = np.random.default_rng(seed).standard_normal((1500, 3))
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        points[:, 1] = np.abs(points[:, 1])
        assert diameter(points) == pytest.approx(pdist(points).max(), rel=1e-7)
    assert diameter(np.zeros((3, 3))) == 0


def test_shapes() -> None:
    ball = shapes.sphere(0.5, 2)
    np.testing.assert_allclose(np.linalg.norm(ball.vertices_m, axis=1), 0.5)
    assert len(ball.faces) == 320
    for shape, extents in (
        (shapes.box((1.0, 2.0, 3.0)), (1, 2, 3)),
        (shapes.cone(0.5, 2.0), (1, 2, 1)),
        (shapes.capsule(0.5, 2.0), (1, 2, 1)),
    ):
        np.testing.assert_allclose(shape.box_corners_m[7], np.array(extents) / 2, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(shape.box_corners_m[0], -np.array(extents) / 2, rtol=1e-6, atol=1e-9)
        solid = trimesh.Trimesh(shape.vertices_m, shape.faces, process=False)
        assert solid.is_watertight
        assert solid.volume > 0, "faces must look outwards"
    tip = shapes.cone(0.5, 2.0).vertices_m[:, 1] > 0.99
    assert tip.sum() == 1
    with pytest.raises(ValueError, match="at least 1"):
        shapes.capsule(0.5, 0.9)
    assert shapes.sphere(0.5).sha256 == shapes.sphere(0.5).sha256 != shapes.sphere(0.6).sha256


def test_real_meshes() -> None:
    root = os.environ.get("CURIO_DATA")
    if not root:
        pytest.skip("CURIO_DATA is not set: no real meshes to read")
    path = Path(root) / "lmo" / "models" / "obj_000001.ply"
    ape = load_mesh(path, "mm")
    assert ape.diameter_m == pytest.approx(0.102099, abs=1e-6)
    assert ape.vertex_colors_srgb is not None
    with pytest.raises(MeshError, match="--mesh-unit"):
        load_mesh(path)
    spot = load_mesh(Path(root) / "meshes" / "spot.obj")
    assert isinstance(spot, Mesh)
    assert spot.faces.shape == (5856, 3)
