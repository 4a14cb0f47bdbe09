"""Confidence and intervals by answers that contradict each other: simulated ones, and photographs of a still scene."""

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from curio_serve.models.reliability import calibrated
from curio_train.errors import CameraError, DataError
from curio_train.evaluation.reliability import Answers, coverage, fit_reliability
from curio_train.evaluation.unlabelled.self_consistency import (
    Pairs,
    adjusted,
    adjustment,
    photographed_pairs,
    read_views,
)
from curio_train.geometry import rotation_6d_from_matrix
from curio_train.metrics.calibration import fit_pair_calibration
from curio_train.scene_code import CONFIDENCE, ROTATION_6D, TRANSLATION, SceneCode
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.world import Object
from scipy.spatial.transform import Rotation

SCALES = np.array([0.003, 0.02, 6.0])


def _answers(num: int, seed: int, object_: Object, wider: float = 1.0) -> Answers:
    """Answers whose errors fall with their confidence; those about photographs err more."""
    random = np.random.default_rng(seed)
    confidences = random.random(num)
    errors = wider * np.abs(random.standard_t(4, (num, 3))) * SCALES * (1.2 - confidences)[:, None]
    return Answers(object_.kind, confidences, errors, random.beta(1, 6, num))


def _pairs(num: int, seed: int, wider: float) -> Pairs:
    """Pairs of such answers: each gap is the difference of two independent errors."""
    random = np.random.default_rng(seed)
    confidences = random.random((num, 2))
    errors = wider * random.standard_t(4, (num, 2, 3)) * SCALES * (1.2 - confidences)[..., None]
    return Pairs("brick", confidences, np.abs(errors[:, 0] - errors[:, 1]), random.random(num) < 0.3)


def test_pairs_that_agree_tell_how_often_an_answer_is_right() -> None:
    """A model that says 0.8 where it is right in 0.5 of cases is corrected, with no truth given."""
    random = np.random.default_rng(0)
    logits = random.normal(0.5, 2.0, (20000, 2))
    right = random.random(logits.shape) < 1 / (1 + np.exp(-(0.6 * logits - 1.0)))
    weight, offset = fit_pair_calibration(logits, right.all(axis=1).tolist())
    assert weight == pytest.approx(0.6, abs=0.05)
    assert offset == pytest.approx(-1.0, abs=0.1)


def test_a_calibration_keeps_the_order_whatever_agrees() -> None:
    random = np.random.default_rng(0)
    logits = random.normal(0, 2, (200, 2))
    for agree in (logits.sum(axis=1) < 0, np.ones(200, bool), np.zeros(200, bool)):
        weight, offset = fit_pair_calibration(logits, agree.tolist())
        assert weight > 0
        assert np.isfinite([weight, offset]).all()


@pytest.mark.parametrize("wider", [1.0, 2.5])
def test_bounds_grow_as_answers_about_photographs_differ_more(wider: float, brick: Object) -> None:
    """Errors of photographs that are so much larger are held in nine of ten cases, without having been seen."""
    rendered = _answers(4000, 1, brick)
    found = adjusted(fit_reliability([rendered]), [rendered], [_pairs(2000, 2, wider)], 500)
    assert found.num_photographs == 500
    assert found.position_widening == pytest.approx(wider, rel=0.15)
    assert found.rotation_widening == pytest.approx(wider, rel=0.15)
    fresh = _answers(4000, 3, brick, wider)
    confidences = np.array([calibrated(found.calibration, value) for value in fresh.confidences.tolist()])
    held = coverage(found.objects[0], confidences, fresh.errors)
    assert 0.86 <= held["position"] <= 0.95
    assert 0.86 <= held["rotation"] <= 0.95


def test_the_same_answers_are_sure_after_calibration(brick: Object) -> None:
    rendered = _answers(2000, 4, brick)
    before = fit_reliability([rendered])
    after = adjusted(before, [rendered], [_pairs(500, 5, 1.0)], 100)
    answered = np.array([calibrated(after.calibration, value) for value in rendered.confidences.tolist()])
    sure = rendered.confidences >= before.objects[0].min_confidence
    assert np.array_equal(answered >= after.objects[0].min_confidence, sure)
    assert "100 photographs: a confidence of 0.5 is answered as" in adjustment(after)


def test_few_pairs_leave_the_bounds_as_they_are(brick: Object) -> None:
    rendered = _answers(2000, 6, brick)
    before = fit_reliability([rendered])
    after = adjusted(before, [rendered], [_pairs(10, 7, 9.0)], 6)
    assert after.position_widening == 0
    assert after.objects[0].bounds[0].lateral_m == before.objects[0].bounds[0].lateral_m
    assert "fewer than 30 pairs" in adjustment(after)


def _photographs(folder: Path, num: int, unit: str | None) -> tuple[Path, np.ndarray]:
    """Files of a camera that moves around a brick at the origin, 1 m away, and the poses of the brick in them."""
    folder.mkdir()
    views, poses = {}, np.tile(np.eye(4), (num, 1, 1))
    for number in range(num):
        poses[number, :3, :3] = Rotation.from_euler("xy", [100, 6 * number], degrees=True).as_matrix()
        poses[number, :3, 3] = [0.01 * number, 0, 1.0 + 0.01 * number]
        cv2.imwrite(str(folder / f"{number:03d}.png"), np.full((480, 640, 3), number, np.uint8))
        in_file = poses[number].copy()
        in_file[:3, 3] *= 1.0 if unit else 5.0  # structure from motion knows no metres
        views[f"{number:03d}.png"] = {"cam_from_world": in_file.tolist(), "unit": unit}
    (folder / "views.json").write_text(json.dumps(views))
    return folder / "views.json", poses


@pytest.mark.parametrize("unit", ["m", None])
def test_answers_about_a_still_scene(unit: str | None, brick_world: TwoStageWorld, tmp_path: Path) -> None:
    """Right answers agree in any unit; one that is off contradicts its neighbours, by as much as it is off."""
    file, poses = _photographs(tmp_path / "photos", 24, unit)

    def predict(images: torch.Tensor) -> SceneCode:
        numbers = images[:, 0, 0, 0].long()
        position = torch.from_numpy(poses[:, :3, 3]).float()[numbers]
        position = torch.where(numbers[:, None] == 3, position + torch.tensor([0.05, 0.0, 0.0]), position)
        rotation = torch.from_numpy(poses[:, :3, :3]).float()[numbers]
        confidence = torch.full((len(images), 1, 1), 0.7)
        code = {TRANSLATION: position[:, None], ROTATION_6D: rotation_6d_from_matrix(rotation)[:, None]}
        return {**code, CONFIDENCE: confidence}

    (pairs,) = photographed_pairs(brick_world, predict, read_views(tmp_path / "photos", file))
    assert len(pairs.agree) == 4 * 24 - (1 + 2 + 3 + 4)
    assert (~pairs.agree).sum() == 3 + 4  # photograph 3 with those before and after it
    assert np.median(pairs.gaps[pairs.agree], axis=0) == pytest.approx([0, 0, 0], abs=2e-3)
    assert pairs.gaps[~pairs.agree, 0] == pytest.approx(0.05, abs=5e-3)


def test_a_scene_of_unknown_scale_needs_answers_that_agree(brick_world: TwoStageWorld, tmp_path: Path) -> None:
    file, _ = _photographs(tmp_path / "photos", 12, None)

    def predict(images: torch.Tensor) -> SceneCode:
        return brick_world.sample(len(images), (int(images[0, 0, 0, 0]),)) | {CONFIDENCE: torch.rand(len(images), 1, 1)}

    with pytest.raises(DataError, match="agree too seldom to tell how large the scene is"):
        photographed_pairs(brick_world, predict, read_views(tmp_path / "photos", file))


def test_a_file_about_other_photographs_is_refused(tmp_path: Path) -> None:
    file, _ = _photographs(tmp_path / "photos", 3, None)
    file.write_text(file.read_text().replace(".png", ".jpg"))
    with pytest.raises(CameraError, match=r"has none of 000\.png and 2 more; write it with curio-train capture"):
        read_views(tmp_path / "photos", file)


def test_one_pose_alone_is_refused(tmp_path: Path) -> None:
    file, _ = _photographs(tmp_path / "photos", 3, None)
    poses = json.loads(file.read_text())
    file.write_text(json.dumps({"000.png": poses["000.png"]}))
    with pytest.raises(DataError, match="has the poses of 1 of 3 photographs"):
        read_views(tmp_path / "photos", file)


@pytest.mark.parametrize("flags", [["--photos", "a", "--intervals"], ["--photos", "a", "--views", "b"]])
def test_photographs_adjust_a_measurement_or_nothing(flags: list[str], circles_run: Path) -> None:
    command = ["from curio_train.commands.export import export; export()", str(circles_run), *flags]
    done = subprocess.run([sys.executable, "-c", *command], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "--photos, --views and --intervals go together" in done.stderr
