"""Which real frames score an object, in data sets of each kind."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from curio_train.data.bop import BopDataset
from curio_train.data.bop_split import ALL_FRAMES, BOP_TARGETS, BY_NUMBER, scored_frames
from curio_train.errors import DataError


def write(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content))


def label(root: Path, scene: int, objects: list[int], num_images: int) -> None:
    pose = {"cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [0, 0, 1000]}
    rows = {image: [{**pose, "obj_id": number} for number in objects] for image in range(num_images)}
    write(root / f"test/{scene:06d}/scene_gt.json", rows)


@pytest.fixture
def linemod(tmp_path: Path) -> Path:
    """LineMOD's layout: scene n shows object n."""
    write(tmp_path / "camera.json", {})
    (tmp_path / "models").mkdir()
    label(tmp_path, 1, [1], 100)
    label(tmp_path, 6, [6], 40)
    return tmp_path


def numbers(root: Path, name: str = "ape") -> list[int]:
    return [target.image_id for target in scored_frames(BopDataset(root), name).targets]


def test_linemod_is_split_by_image_number(linemod: Path) -> None:
    write(linemod / "test_targets_bop19.json", [{"scene_id": 1, "im_id": 5, "obj_id": 1, "inst_count": 1}])
    assert scored_frames(BopDataset(linemod), "ape").split_name == BY_NUMBER
    found = numbers(linemod)
    assert len(found) == 85
    assert sorted(set(range(100)) - set(found))[:4] == [3, 10, 17, 23]
    assert numbers(linemod, "cat") == [n for n in found if n < 40]


@pytest.mark.parametrize(
    ("place", "lines"),
    [
        ("image_set/ape_test.txt", "000002\n000007\n"),
        ("ape/test.txt", "LINEMOD/ape/JPEGImages/000002.jpg\nLINEMOD/ape/JPEGImages/000007.jpg\n"),
        ("test/000001/test.txt", "2\n7"),
    ],
)
def test_a_published_list_comes_first(linemod: Path, place: str, lines: str) -> None:
    write(linemod / place, lines)
    assert scored_frames(BopDataset(linemod), "ape").split_name == place
    assert numbers(linemod) == [2, 7]
    assert scored_frames(BopDataset(linemod), "cat").split_name == BY_NUMBER


def test_scenes_of_several_objects_have_bops_targets(linemod: Path) -> None:
    label(linemod, 2, [1, 6], 20)
    assert scored_frames(BopDataset(linemod), "ape").split_name == ALL_FRAMES
    assert len(numbers(linemod)) == 120
    targets = [{"scene_id": 2, "im_id": image, "obj_id": 1, "inst_count": 1} for image in (4, 9)]
    write(linemod / "test_targets_bop19.json", targets)
    frames = scored_frames(BopDataset(linemod), "ape")
    assert frames.split_name == BOP_TARGETS
    assert [(t.scene_id, t.image_id) for t in frames.targets] == [(2, 4), (2, 9)]
    with pytest.raises(DataError, match="found no labelled frame of cat among bop19 targets"):
        scored_frames(BopDataset(linemod), "cat")


@pytest.mark.parametrize(("lines", "text"), [("", "found nothing"), ("3\nfour.png", "found four.png")])
def test_broken_lists_are_named(linemod: Path, lines: str, text: str) -> None:
    write(linemod / "image_set/ape_test.txt", lines)
    with pytest.raises(DataError, match=rf"ape_test\.txt: {text}, expected a number"):
        scored_frames(BopDataset(linemod), "ape")


def test_a_list_of_other_frames_is_refused(linemod: Path) -> None:
    write(linemod / "image_set/ape_test.txt", "5000\n")
    with pytest.raises(DataError, match=r"found no labelled frame of ape among image_set/ape_test\.txt"):
        scored_frames(BopDataset(linemod), "ape")
