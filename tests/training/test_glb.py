"""A scene written as GLB stands where it stood: trimesh reads every pose back, and so do we, with the whole code."""

import json
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from curio_train.drawing.album import scenes_of
from curio_train.drawing.glb import from_glb, to_glb
from curio_train.drawing.pictures import SceneContext
from curio_train.drawing.scenes import Placed, Scene, mesh_world, read_scenes
from curio_train.errors import DataError
from curio_train.geometry import Pose
from curio_train.meshes.shapes import box, chair
from scipy.spatial.transform import Rotation

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
K = np.array([[600.0, 0, 319.5], [0, 610.0, 245.0], [0, 0, 1]])


def scene() -> Scene:
    rotations = Rotation.random(3, random_state=4).as_matrix()
    positions = np.array([[0.1, -0.05, 0.7], [-0.2, 0.1, 0.9], [0.0, 0.0, 0.5]])
    kinds = ("chair", "chair", "box")
    objects = [
        Placed(kind, Pose(rotation, position), (0.9, 0.5, 0.2), confidence)
        for kind, rotation, position, confidence in zip(kinds, rotations, positions, (1.0, 0.5, 0.75), strict=True)
    ]
    return Scene("frame", 640, 480, K, tuple(objects), np.array([-0.3, -0.8, -1.1]), Path("frame.png"))


def context() -> SceneContext:
    return SceneContext({"chair": chair(0.2), "box": box((0.1, 0.2, 0.3))})


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "frame.glb"
    path.write_bytes(to_glb(scene(), context()))
    return path


def test_trimesh_reads_every_pose_and_size(file: Path) -> None:
    loaded = trimesh.load(file)
    for number, item in enumerate(scene().objects):
        matrix, geometry = loaded.graph[f"{number:02d}-{item.kind}"]
        expected = np.eye(4)
        expected[:3, :3], expected[:3, 3] = item.pose.rotation, item.pose.translation_m
        assert matrix == pytest.approx(FLIP @ expected, abs=1e-6)
        mesh = context().mesh(item.kind)
        assert loaded.geometry[geometry].extents == pytest.approx(np.ptp(mesh.vertices_m, axis=0), rel=1e-5)


def test_the_code_comes_back(file: Path) -> None:
    back, there = from_glb(file), scene()
    assert (back.width, back.height, back.photograph, back.world) == (640, 480, Path("frame.png"), None)
    assert back.camera_matrix == pytest.approx(K)
    assert back.light == pytest.approx(there.light, abs=1e-5)
    for one, other in zip(back.objects, there.objects, strict=True):
        assert one.kind == other.kind
        assert one.pose.rotation == pytest.approx(other.pose.rotation, abs=1e-5)
        assert one.pose.translation_m == pytest.approx(other.pose.translation_m, abs=1e-5)
        assert (*one.color_srgb, one.confidence) == pytest.approx((*other.color_srgb, other.confidence), abs=1e-5)


def test_the_ground_of_a_world_lies_level(tmp_path: Path) -> None:
    world = mesh_world("chairs")
    code = {name: values[0].tolist() for name, values in world.sample(1, (3,)).items()}
    lines = tmp_path / "codes.jsonl"
    lines.write_text(json.dumps({"world": "chairs", "code": code}))
    (drawn,) = read_scenes(lines)
    path = tmp_path / "chairs.glb"
    path.write_bytes(to_glb(drawn, SceneContext.of_world(world)))
    loaded = trimesh.load(path)
    heights = [loaded.graph[f"{i:02d}-chair"][0][1, 3] for i in range(len(drawn.objects))]
    assert np.ptp(heights) < 1e-6  # all stand on one plane, whose normal is +y
    back = from_glb(path)
    assert back.light == pytest.approx(SceneContext.of_world(world).light, abs=1e-5)
    assert back.objects[0].pose.rotation == pytest.approx(drawn.objects[0].pose.rotation, abs=1e-5)


def test_a_light_from_straight_behind_is_no_exception(tmp_path: Path) -> None:
    path = tmp_path / "lit.glb"
    for light in ([0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]):
        path.write_bytes(to_glb(Scene("a", 640, 480, K, (), np.array(light)), context()))
        assert from_glb(path).light == pytest.approx(light, abs=1e-6)


@pytest.mark.parametrize("content", [b"", b"glTF", b"no glb at all, but long enough for a header", None])
def test_what_is_no_glb_is_refused(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "file.glb"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match=r"file\.glb"):
        from_glb(path)


def test_another_programs_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.glb"
    path.write_bytes(trimesh.Scene([trimesh.creation.box()]).export(file_type="glb"))
    with pytest.raises(DataError, match="no camera written by curio"):
        from_glb(path)


def _edited(file: Path, edit: Callable[[dict[str, Any]], object]) -> Path:
    """The file after its description was changed, as applications change it."""
    content = file.read_bytes()
    length = int.from_bytes(content[12:16], "little")
    tree = json.loads(content[20 : 20 + length])
    edit(tree)
    out = file.with_name("edited.GLB")
    out.write_bytes(_of_tree(tree))
    return out


def _number(tree: dict[str, Any], name: str) -> int:
    return next(number for number, node in enumerate(tree["nodes"]) if node.get("name") == name)


def test_a_group_that_was_moved_takes_its_objects_along(file: Path) -> None:
    def group(tree: dict[str, Any]) -> None:
        child = _number(tree, "02-box")
        for node in tree["nodes"]:
            node["children"] = [number for number in node.get("children", ()) if number != child]
        tree["nodes"].append({"name": "empty", "translation": [0.1, 0.0, 0.0], "children": [child]})

    (found,) = scenes_of(_edited(file, group))
    before, after = scene().objects[2].pose, found.objects[2].pose
    assert after.translation_m - before.translation_m == pytest.approx([0.1, 0, 0], abs=1e-5)
    assert after.rotation == pytest.approx(before.rotation, abs=1e-5)
    assert found.objects[0].pose.translation_m == pytest.approx(scene().objects[0].pose.translation_m, abs=1e-5)


@pytest.mark.parametrize("scale", [[2.0, 2, 2], [-1.0, 1, 1]])
def test_an_object_that_was_scaled_is_refused(file: Path, scale: list[float]) -> None:
    def change(tree: dict[str, Any]) -> None:
        node = tree["nodes"][_number(tree, "02-box")]
        node.pop("matrix", None)
        node["scale"] = scale

    with pytest.raises(DataError, match="02-box is scaled or mirrored"):
        from_glb(_edited(file, change))


def _of_tree(tree: object) -> bytes:
    text = tree if isinstance(tree, bytes) else json.dumps(tree).encode()
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text


@pytest.mark.parametrize(
    "tree",
    [
        b"[" * 100_000,
        {"nodes": 5},
        {"nodes": [{"extras": {"curio": {}}}]},
        {"nodes": [{"name": "camera", "extras": {"curio": {}}}]},
        {"nodes": [{"name": "camera", "matrix": [0] * 16, "extras": {"curio": {}}}]},
        {"nodes": [{"name": "camera", "extras": {"curio": {}}}, {"name": "light", "extras": {"curio": {}}}]},
    ],
)
def test_damaged_content_is_refused(tmp_path: Path, tree: object) -> None:
    path = tmp_path / "damaged.glb"
    path.write_bytes(_of_tree(tree))
    with pytest.raises(DataError, match=r"damaged\.glb"):
        from_glb(path)


@pytest.mark.parametrize("read", [from_glb, lambda path: list(read_scenes(path))])
def test_only_regular_files_of_some_size_are_read(tmp_path: Path, read: Callable[[Path], object]) -> None:
    pipe, large = tmp_path / "pipe", tmp_path / "large"
    os.mkfifo(pipe)
    large.touch()
    os.truncate(large, 50 << 30)
    for file, expected in ((pipe, "not a regular file"), (Path("/dev/zero"), "not a regular file"), (large, "at most")):
        with pytest.raises(DataError, match=expected):
            read(file)


@pytest.mark.parametrize(
    "line",
    [
        "[" * 100_000,
        '{"detections": [], "image": "a.png", "width": 1e999, "height": 4, "camera_matrix": [[1,0,0],[0,1,0],[0,0,1]]}',
        '{"world": "spheres", "code": [1]}',
        '{"world": "spheres", "code": {"a": [[1], []]}}',
        '{"world": "spheres", "code": {}}',
        '{"world": "spheres", "code": {"light": 1}}',
    ],
)
def test_damaged_lines_are_refused(tmp_path: Path, line: str) -> None:
    path = tmp_path / "found.jsonl"
    path.write_text(f"{line}\n")
    with pytest.raises(DataError, match=r"found\.jsonl, line 1"):
        list(read_scenes(path))
