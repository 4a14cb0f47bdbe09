"""BOP data sets: what is read, in which unit, what is refused, and that frames never open a label file."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from curio_train.data.bop import LINEMOD_CLASSES, BopDataset
from curio_train.errors import CameraError, DataError, UsageError
from PIL import Image

K = [57.0, 0, 31.5, 0, 57.0, 23.5, 0, 0, 1]
IDENTITY = [1, 0, 0, 0, 1, 0, 0, 0, 1]
HALF_TURN = [-1, 0, 0, 10, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]


def write(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content))


def add_image(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (64, 48), (10, 20, 30)).save(path)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """LineMOD in small: two scenes of a test split with JPEG and PNG, one grey training scene."""
    root = tmp_path / "lm"
    write(
        root / "camera.json", {"fx": 57, "fy": 57, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48, "depth_scale": 1}
    )
    info = {
        "1": {"diameter": 100.0},
        "10": {"diameter": 150.0, "symmetries_discrete": [HALF_TURN]},
        "3": {"diameter": 160.0, "symmetries_continuous": [{"axis": [0, 0, 1], "offset": [1, 2, 3]}]},
    }
    write(root / "models" / "models_info.json", info)
    trimesh.creation.box((60, 0.1, 80)).export(root / "models" / "obj_000001.ply")
    trimesh.creation.box((90, 0.1, 120)).export(root / "models" / "obj_000010.ply")
    add_scene(root / "test" / "000001", {4: "rgb/000004.jpg", 12: "rgb/000012.png"}, object_id=1)
    add_scene(root / "test" / "000010", {0: "rgb/000000.png"}, object_id=10)
    add_scene(root / "train" / "000001", {7: "gray/000007.tif"}, object_id=1)
    targets = [{"scene_id": 1, "im_id": 4, "obj_id": 1, "inst_count": 1}]
    write(root / "test_targets_bop19.json", targets)
    return root


def add_scene(scene: Path, images: dict[int, str], object_id: int) -> None:
    for name in images.values():
        add_image(scene / name)
    truth = {"cam_R_m2c": IDENTITY, "cam_t_m2c": [10, -20, 1000], "obj_id": object_id}
    write(scene / "scene_camera.json", {str(i): {"cam_K": K, "depth_scale": 1.0} for i in images})
    write(scene / "scene_gt.json", {str(i): [truth, {**truth, "obj_id": 99}] for i in images})
    write(scene / "scene_gt_info.json", {str(i): [{"visib_fract": 0.75}, {"visib_fract": 0.5}] for i in images})


def test_frames(root: Path) -> None:
    frames = list(BopDataset(root).frames())
    assert [(f.scene_id, f.image_id, f.path.name) for f in frames] == [
        (1, 4, "000004.jpg"),
        (1, 12, "000012.png"),
        (10, 0, "000000.png"),
    ]
    assert all((f.width, f.height) == (64, 48) for f in frames)
    assert np.array_equal(frames[0].matrix, np.reshape(K, (3, 3)))
    assert [f.image_id for f in BopDataset(root).frames(scene_id=10)] == [0]
    assert [f.path.name for f in BopDataset(root).frames("train")] == ["000007.tif"]


def test_frames_do_not_open_labels(root: Path) -> None:
    for path in root.glob("*/*/scene_gt*.json"):
        path.write_text("labels that nobody may read")
    assert len(list(BopDataset(root).frames())) == 3
    with pytest.raises(DataError, match=r"scene_gt\.json: not JSON"):
        next(BopDataset(root).annotations())


def test_annotations_are_in_metres(root: Path) -> None:
    (only,) = BopDataset(root).annotations(name="eggbox")
    assert (only.scene_id, only.image_id, only.object_id, only.visible_fraction) == (10, 0, 10, 0.75)
    assert only.pose.translation_m.tolist() == pytest.approx([0.01, -0.02, 1.0])
    assert np.array_equal(only.pose.rotation, np.eye(3))
    assert len(list(BopDataset(root).annotations())) == 6
    (root / "test/000010/scene_gt_info.json").unlink()
    assert next(BopDataset(root).annotations(name="eggbox")).visible_fraction is None


def test_models(root: Path) -> None:
    data = BopDataset(root)
    assert data.classes == ("ape", "eggbox")
    assert data.mesh("ape").diameter_m == pytest.approx(0.1, rel=1e-4)
    assert data.evaluation_mesh("ape").diameter_m == pytest.approx(0.1, rel=1e-4)
    (root / "models_eval").mkdir()
    trimesh.creation.box((30, 0.1, 40)).export(root / "models_eval" / "obj_000001.ply")
    assert data.evaluation_mesh("ape").diameter_m == pytest.approx(0.05, rel=1e-4)
    assert data.camera.matrix.tolist() == np.reshape(K, (3, 3)).tolist()
    assert data.targets()[0].num_instances == 1


def test_meshes_have_a_source_and_a_licence(root: Path) -> None:
    assert "LineMOD (Hinterstoisser et al. 2012)" in BopDataset(root).attribution
    assert BopDataset(root).attribution.endswith("CC BY 4.0")
    for number in (5, 6, 8, 9, 11, 12):
        (root / "models" / f"obj_{number:06d}.ply").touch()
    assert BopDataset(root).attribution.startswith("Linemod-Occluded (Brachmann et al. 2014)")
    assert BopDataset(root).attribution.endswith("CC BY-SA 4.0")


def test_symmetries_are_in_metres(root: Path) -> None:
    data = BopDataset(root)
    assert not data.model_info("ape").is_symmetric
    (symmetry,) = data.model_info("eggbox").symmetries
    assert symmetry[:, 3].tolist() == [0.01, 0, 0, 1]
    assert symmetry[:3, :3].tolist() == [[-1, 0, 0], [0, -1, 0], [0, 0, 1]]
    bowl = data.model_info("bowl")
    assert bowl.is_symmetric
    ((axis, point),) = bowl.symmetry_axes
    assert axis.tolist() == [0, 0, 1]
    assert point.tolist() == pytest.approx([0.001, 0.002, 0.003])


def test_linemod_names() -> None:
    assert len(LINEMOD_CLASSES) == 13
    assert [BopDataset.object_id(name) for name in LINEMOD_CLASSES] == [1, 2, 4, 5, 6, 8, 9, 10, 11, 12, 13, 14, 15]
    with pytest.raises(UsageError) as caught:
        BopDataset.object_id("Ape")
    assert "--class" in str(caught.value)
    for name in LINEMOD_CLASSES:
        assert name in str(caught.value)


def test_not_a_data_set(root: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no such folder.*hf download bop-benchmark/lm"):
        BopDataset(tmp_path / "nowhere")
    with pytest.raises(DataError, match=r"not a BOP data set, looked for camera.json and models.*did you mean .*lm"):
        BopDataset(tmp_path)
    (tmp_path / "lmo").mkdir()
    with pytest.raises(DataError, match="hf download bop-benchmark/lmo"):
        BopDataset(tmp_path / "lmo")
    with pytest.raises(DataError, match="no mesh of iron here; found meshes of: ape eggbox"):
        BopDataset(root).mesh("iron")
    with pytest.raises(DataError, match="splits here: test train"):
        next(BopDataset(root).frames("val"))
    with pytest.raises(DataError, match="found no scene 000005, only 000001 000010"):
        next(BopDataset(root).frames(scene_id=5))


SCENE = "test/000001/"


@pytest.mark.parametrize(
    ("file", "content", "error", "text"),
    [
        (SCENE + "scene_camera.json", "{", DataError, "not JSON"),
        (SCENE + "scene_camera.json", {}, DataError, "4/cam_K: found no such entry"),
        (SCENE + "scene_camera.json", {"4": {"cam_K": K[:8]}}, DataError, "4/cam_K: found [57.0"),
        (SCENE + "scene_camera.json", {"4": {"cam_K": ["a"] * 9}}, DataError, "expected 9 finite"),
        (SCENE + "scene_camera.json", {"4": {"cam_K": [0] * 9}}, CameraError, "4/cam_K: K is"),
        (SCENE + "scene_camera.json", {"4": {"cam_K": [570, 0, 315, 0, 570, 235, 0, 0, 1]}}, CameraError, "64x48"),
        (SCENE + "rgb/000004.jpg", "no image", DataError, "not a readable image"),
        (SCENE + "scene_gt.json", [1], DataError, "expected an object"),
        (SCENE + "scene_gt.json", {"4": 1}, DataError, "expected a list"),
        (SCENE + "scene_gt.json", {"4": [{"obj_id": "1"}]}, DataError, "4/0, obj_id: found '1'"),
        (SCENE + "scene_gt.json", {"4": [{"obj_id": 1}]}, DataError, "cam_R_m2c: found no such entry"),
        (SCENE + "scene_gt.json", {"4": [{"obj_id": 1, "cam_R_m2c": [2] * 9}]}, DataError, "not a rotation"),
        (SCENE + "scene_gt_info.json", {"4": []}, DataError, "4/0/visib_fract: found no such entry"),
        ("models/models_info.json", {}, DataError, "models_info.json, 1: found no such entry"),
        ("models/models_info.json", {"1": {"diameter": None}}, DataError, "1, diameter: found None"),
        ("models/models_info.json", {"1": {"diameter": 0}}, DataError, "diameter: found 0.0, expected more than 0"),
        (
            "models/models_info.json",
            {"1": {"diameter": 9, "symmetries_continuous": [{"axis": [0, 0, 0], "offset": [0, 0, 0]}]}},
            DataError,
            "axis: found 0 in all directions",
        ),
        (
            "models/models_info.json",
            {"1": {"diameter": 9, "symmetries_discrete": [[2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1]]}},
            DataError,
            "symmetries_discrete/0: found [[2.0",
        ),
        ("camera.json", {"fx": 1}, CameraError, "camera.json: unknown format"),
        ("test_targets_bop19.json", [{"scene_id": 1}], DataError, "0, im_id"),
    ],
)
def test_broken_files(root: Path, file: str, content: Any, error: type[Exception], text: str) -> None:
    write(root / file, content)
    data = BopDataset(root)
    with pytest.raises(error) as caught:
        _ = list(data.frames()), list(data.annotations()), data.model_info("ape"), data.targets(), data.camera
    assert text in str(caught.value)
    assert file.rsplit("/", 1)[-1] in str(caught.value)


def test_scene_without_images(root: Path) -> None:
    for path in (root / "test/000010/rgb").iterdir():
        path.unlink()
    with pytest.raises(DataError, match="000010: found no images such as"):
        list(BopDataset(root).frames())


def test_real_data() -> None:
    folder = os.environ.get("CURIO_DATA")
    if not folder:
        pytest.skip("CURIO_DATA is not set: no real data sets to read")
    occluded = BopDataset(Path(folder) / "lmo")
    assert occluded.classes == ("ape", "can", "cat", "driller", "duck", "eggbox", "glue", "holepuncher")
    assert len(list(occluded.frames())) == 100
    assert {name for name in occluded.classes if occluded.model_info(name).is_symmetric} == {"eggbox", "glue"}
    apes = list(occluded.annotations(name="ape"))
    assert len(apes) == 97
    assert all(0.5 < a.pose.translation_m[2] < 1.5 for a in apes)
    visible = [a for a in apes if a.visible_fraction is not None and a.visible_fraction >= 0.8]
    assert 50 < len(visible) < 70
    assert len(occluded.targets()) > 500
    single = BopDataset(Path(folder) / "lm")
    assert [(f.scene_id, f.image_id) for f in single.frames()] == [(1, 0), (1, 31), (6, 0)]
    assert single.classes == ("ape", "cat")
    for name in occluded.classes:
        expected = occluded.model_info(name).diameter_m
        assert occluded.mesh(name).diameter_m == pytest.approx(expected, rel=2e-2)
        assert occluded.evaluation_mesh(name).diameter_m == pytest.approx(expected, rel=2e-2)
