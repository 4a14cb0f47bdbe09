"""How large a scene is, by what networks read in photographs of it."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from curio_train.camera import Intrinsics
from curio_train.capture.structure import Structure
from curio_train.commands import train as train_command
from curio_train.data.bop import BopDataset
from curio_train.errors import DataError, UsageError
from curio_train.evaluation.unlabelled.scene_scale import mean_scale, scale_by_objects
from curio_train.refinement import render_and_compare

MODELS = Path(__file__).parents[2] / "models"


def test_objects_count_alike_and_say_how_far_they_differ() -> None:
    scale, line = mean_scale({"ape": 0.2 * np.exp(0.03), "cat": 0.2 * np.exp(-0.01), "duck": 0.2 * np.exp(-0.02)})
    assert scale == pytest.approx(0.2)
    assert "ape +3.0 %, cat -1.0 %, duck -2.0 %; the mean is good to 1.5 %" in line
    assert mean_scale({"ape": 0.2}) == (pytest.approx(0.2), "scale by each object beside their mean: ape +0.0 %")


def test_two_networks_of_one_object_are_refused(tmp_path: Path) -> None:
    """Neither is to count silently, and nothing is read before."""
    for name in ("first", "second"):
        (tmp_path / name).symlink_to(MODELS / "ape")
    with pytest.raises(UsageError, match=r"^--objects .*: found first and second, both ape; expected one of each"):
        scale_by_objects(tmp_path, None, Intrinsics(np.eye(3), 640, 480), pytest.fail)


def call(capsys: pytest.CaptureFixture[str], *flags: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as exit_:
        train_command.train(["capture", "--calibrate", *map(str, flags)])
    captured = capsys.readouterr()
    return int(exit_.value.code or 0), captured.out, captured.err


def test_models_that_are_not_there_are_told_before_photographs_are_matched(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "photos").mkdir()  # has none, which the matching would say
    camera = {"camera_matrix": [[572.4, 0, 325.3], [0, 573.6, 242], [0, 0, 1]], "width": 640, "height": 480}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    flags = ["--images", tmp_path / "photos", "--camera", tmp_path / "camera.json"]
    flags += ["--views-out", tmp_path / "views.json", "--objects", tmp_path / "nowhere"]
    status, _, errors = call(capsys, *flags)
    assert status == 2
    assert f"--objects {tmp_path}/nowhere: no such folder; expected runs or models of linemod there" in errors
    status, _, errors = call(capsys, *flags, "--distance-m", 1)
    assert status == 2
    assert "both say how large the scene is; leave one out" in errors, "what contradicts itself comes first"


@pytest.mark.skipif("CURIO_DATA" not in os.environ, reason="CURIO_DATA is unset: no real data here")
def test_real_frames_in_metres(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By the shipped ape alone, against the labels: as far as an object moved before the camera is known of both."""
    data = Path(os.environ["CURIO_DATA"]) / "lmo"
    frames, models, views = data / "test" / "000002" / "rgb", tmp_path / "models", tmp_path / "views.json"
    models.mkdir()
    (models / "ape").symlink_to(MODELS / "ape")
    flags = ["--images", frames, "--every", 2, "--camera", data / "camera.json", "--views-out", views]
    status, out, err = call(capsys, *flags, "--objects", models, "--data", data)
    assert status == 0, err
    assert "beside their mean: ape +0.0 %" in out
    assert "in metres" in out

    places = json.loads(views.read_text())
    seen = [a for a in BopDataset(data).annotations("test", "duck") if f"{a.image_id:06}.png" in places]
    away, centres = [], []
    for target in seen:
        matrix = np.array(places[f"{target.image_id:06}.png"]["cam_from_world"])
        away.append(matrix[:3, :3].T @ target.pose.translation_m)
        centres.append(-matrix[:3, :3].T @ matrix[:3, 3])
    # Neighbours: things are moved now and then.
    moved, differ = np.diff(centres, axis=0), np.diff(away, axis=0)
    far = np.linalg.norm(moved, axis=1) > 0.1
    ratio = np.linalg.norm(differ[far], axis=1) / np.linalg.norm(moved[far], axis=1)
    assert far.sum() > 10
    assert np.median(ratio) == pytest.approx(1, abs=0.04)


@pytest.mark.skipif("CURIO_DATA" not in os.environ, reason="CURIO_DATA is unset: no real data here")
def test_what_tells_no_scale_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a camera that stands still, however well poses are refined; and of a model for another camera."""
    monkeypatch.setattr(render_and_compare, "_STEPS", 1)
    data = Path(os.environ["CURIO_DATA"]) / "lmo"
    photographs = tuple(sorted((data / "test" / "000002" / "rgb").iterdir())[:3])
    camera = BopDataset(data).camera
    still = Structure(photographs, np.tile(np.eye(4), (3, 1, 1)), camera, np.zeros((1, 3)), 0.5)
    told: list[str] = []
    with pytest.raises(UsageError, match=str(tmp_path)):
        scale_by_objects(tmp_path, data, camera, told.append)
    (tmp_path / "lmo").symlink_to(MODELS / "lmo")
    with pytest.raises(DataError, match=r"none of the objects .*--distance-m"):
        scale_by_objects(tmp_path, data, camera, told.append)(still)
    assert told == [f"{name}: seen too seldom to tell" for name in BopDataset(data).classes], "all that one model finds"
    (tmp_path / "lmo").unlink()
    (tmp_path / "ape").symlink_to(MODELS / "ape")  # one object is loaded sooner than eight
    longer = replace(camera, matrix=camera.matrix * [[1.2], [1.2], [1]])
    with pytest.raises(UsageError, match=r"focal length of 572\.4 pixels, but --camera has 686\.9"):
        scale_by_objects(tmp_path, data, longer, told.append)
