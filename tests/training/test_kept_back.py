"""Photographs that judge a part's model stay those that it did not learn from, whatever is added to the folder."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from curio_train.commands.prepare import prepared
from curio_train.config import RunConfig
from curio_train.data.photographs import FEWEST_TO_LEARN_FROM, NUM_JUDGED
from curio_train.errors import MeshError
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.meshes.meshes import to_ply
from curio_train.meshes.shapes import box, painted
from curio_train.worlds import build
from curio_train.worlds.capture import CapturePhotographs
from curio_train.worlds.options import CaptureOptions
from curio_train.worlds.single_object.two_stage import TwoStageWorld

CAMERA = '{"camera_matrix": [[80, 0, 40], [0, 80, 30], [0, 0, 1]], "width": 80, "height": 60}'


def photograph(folder: Path, *names: str) -> None:
    for name in names:
        pixels = np.random.default_rng([ord(letter) for letter in name]).integers(0, 255, (60, 80, 3))
        cv2.imwrite(str(folder / f"{name}.png"), pixels)


@pytest.fixture
def options(tmp_path: Path) -> CaptureOptions:
    (tmp_path / "part.ply").write_bytes(to_ply(painted(box((0.1, 0.2, 0.15)), 0.5)))
    (tmp_path / "camera.json").write_text(CAMERA)
    (tmp_path / "photos").mkdir()
    return CaptureOptions((tmp_path / "part.ply",), tmp_path / "camera.json", tmp_path / "photos", mesh_unit="m")


def split(options: CaptureOptions) -> tuple[set[str], set[str]]:
    """Names of the photographs that judge and of those that the model may learn from."""
    world = build(options)
    assert isinstance(world, TwoStageWorld)
    assert isinstance(world.photographs, CapturePhotographs)
    judged, _ = world.photographs.judged(1000)
    return {path.stem for path in judged}, {path.stem for path in world.photographs.unlabelled_paths()}


def test_photographs_that_are_added_never_judge(options: CaptureOptions, tmp_path: Path) -> None:
    photograph(options.photos, *(f"b{number:03}" for number in range(FEWEST_TO_LEARN_FROM)))
    run = prepared(RunConfig(options), tmp_path, pytest.fail, lambda _: None).world
    assert isinstance(run, CaptureOptions)
    judged, learned = split(run)
    assert len(judged) == NUM_JUDGED
    assert judged | learned == {f"b{number:03}" for number in range(FEWEST_TO_LEARN_FROM)}
    photograph(options.photos, *(f"a{number:03}" for number in range(30)))
    assert split(run)[0] == judged
    assert split(run)[1] >= learned
    assert split(replace(run, judged=()))[0] & learned, "by their place in the folder, others would judge"
    for name in judged:
        (options.photos / f"{name}.png").unlink()
    assert split(run)[0], "others judge where all of these are gone"


def test_a_run_that_goes_on_from_another_keeps_its_photographs(options: CaptureOptions, tmp_path: Path) -> None:
    photograph(options.photos, *(f"b{number:03}" for number in range(FEWEST_TO_LEARN_FROM)))
    first = prepared(RunConfig(options), tmp_path, pytest.fail, lambda _: None)
    RunFolder(tmp_path / "first", first).write_config(new=True)
    photograph(options.photos, *(f"a{number:03}" for number in range(30)))
    for init in (tmp_path / "first", tmp_path / "first" / "models" / "part" / "1"):
        again = prepared(replace(RunConfig(options), init=init), tmp_path, pytest.fail, lambda _: None)
        assert isinstance(again.world, CaptureOptions)
        assert split(again.world)[0] == split(first.world)[0]  # type: ignore[arg-type]


def test_a_mesh_that_has_changed_is_refused(options: CaptureOptions, tmp_path: Path) -> None:
    photograph(options.photos, "a", "b", "c")
    run = prepared(RunConfig(options), tmp_path, lambda _: None, lambda _: None).world
    assert isinstance(build(run), TwoStageWorld)
    (tmp_path / "part.ply").write_bytes(to_ply(painted(box((0.2, 0.4, 0.3)), 0.5)))
    with pytest.raises(MeshError, match=r"part\.ply: is not the file that the run was trained with"):
        build(run)


def test_few_photographs_all_judge_and_none_of_them_is_ever_learned_from(
    options: CaptureOptions, tmp_path: Path
) -> None:
    photograph(options.photos, *(f"b{number:03}" for number in range(5)))
    doubts: list[str] = []
    run = prepared(RunConfig(options), tmp_path, doubts.append, lambda _: None).world
    assert isinstance(run, CaptureOptions)
    few = {f"b{number:03}" for number in range(5)}
    assert split(run) == (few, set())
    photograph(options.photos, *(f"a{number:03}" for number in range(FEWEST_TO_LEARN_FROM)))
    assert split(run)[0] == few
    assert len(split(run)[1]) == FEWEST_TO_LEARN_FROM
