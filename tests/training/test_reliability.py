"""When answers are sure and how far off they are: bounds, the errors that they bound, and the file beside a model."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from curio_proto.v1.model_spec_pb2 import ObjectReliability, PoseBounds, Reliability
from curio_serve.errors import ModelError
from curio_serve.models.model_folder import open_model
from curio_train.commands import export as export_command
from curio_train.errors import ExportError
from curio_train.evaluation.reliability import Answers, coverage, fit_reliability, held_out_answers, pose_errors
from curio_train.export.folder import ModelFolder
from curio_train.export.write_model import Exported
from curio_train.geometry import Pose
from curio_train.metrics.conformal import conformal_quantile, error_bounds, sure_from
from curio_train.scene_code import CONFIDENCE, SceneCode
from curio_train.worlds.several_objects.scenes import ObjectScenes
from curio_train.worlds.single_object.two_stage import TwoStageWorld, frame_camera
from curio_train.worlds.single_object.world import Object, pose_layout, position_field
from google.protobuf import json_format
from scipy.spatial.transform import Rotation


def _drawn(num: int, seed: int, object_: Object) -> Answers:
    """Answers whose errors have long tails and fall with their confidence."""
    random = np.random.default_rng(seed)
    confidences = random.random(num)
    scale = np.array([0.004, 0.03, 8.0]) * (1.2 - confidences)[:, None]
    errors = np.abs(random.standard_t(2, (num, 3))) * scale
    return Answers(object_.kind, confidences, errors, random.beta(1, 6, num))


def test_the_quantile_counts_the_new_answer() -> None:
    """Of nine errors the largest bounds a tenth with a probability of 90 %; eight are too few."""
    assert conformal_quantile(np.arange(9)[::-1], 0.9) == 8
    assert conformal_quantile(np.arange(99), 0.9) == 89
    with pytest.raises(ValueError, match="8 errors are too few"):
        conformal_quantile(np.arange(8), 0.9)


@pytest.mark.parametrize("confidences", [np.arange(100) / 100, np.array([0.0] * 90 + [0.5] * 10), np.full(100, 0.3)])
def test_at_most_one_in_twenty_is_sure_without_the_object(confidences: np.ndarray) -> None:
    assert (confidences >= sure_from(confidences.tolist())).mean() <= 0.05


@pytest.mark.parametrize("seed", range(3))
def test_intervals_hold_in_nine_of_ten_new_answers(seed: int, brick: Object) -> None:
    fitted = fit_reliability([_drawn(2000, seed, brick)]).objects[0]
    fresh = _drawn(4000, 1000 + seed, brick)
    held = coverage(fitted, fresh.confidences, fresh.errors)
    assert 0.87 <= held["position"] <= 0.93
    assert 0.87 <= held["rotation"] <= 0.93
    assert (fresh.without >= fitted.min_confidence).mean() < 0.07


def test_surer_answers_have_smaller_intervals(brick: Object) -> None:
    drawn = _drawn(4000, 5, brick)
    bounds = error_bounds(drawn.confidences, drawn.errors, 0.2)
    assert [one.min_confidence for one in bounds] == sorted(one.min_confidence for one in bounds)
    assert len(bounds) == 4
    assert bounds[-1].lateral_m < bounds[0].lateral_m
    assert bounds[-1].rotation_deg < bounds[0].rotation_deg


def test_too_few_sure_answers_are_refused(brick: Object) -> None:
    drawn = _drawn(2000, 0, brick)
    unsure = Answers(drawn.kind, drawn.confidences * 0.01, drawn.errors, drawn.without)
    with pytest.raises(ExportError, match="of 2000 answers about brick too few are sure"):
        fit_reliability([unsure])


def test_errors_across_along_and_of_a_symmetric_part(brick: Object) -> None:
    """3 mm across and 8 mm along a slanted line of sight; the brick looks alike after half a turn about z."""
    sight = np.array([0.6, 0.0, 0.8])
    true = Rotation.from_euler("zyx", [20, 30, 40], degrees=True).as_matrix()
    turned = true @ Rotation.from_euler("z", 180, degrees=True).as_matrix()
    off = turned @ Rotation.from_euler("x", 5, degrees=True).as_matrix()
    truth = Pose(true, 0.5 * sight + [0.0, 0.003, 0.0] + 0.008 * sight)
    errors = pose_errors([Pose(turned, 0.5 * sight), Pose(off, 0.5 * sight)], [truth, truth], brick.kind)
    assert errors[0] == pytest.approx([0.003, 0.016, 0.0], abs=1e-5)
    assert errors[1, 2] == pytest.approx(5, abs=1e-4)


def test_answers_on_renderings(brick_world: TwoStageWorld, tmp_path: Path) -> None:
    """Frames with the object and backgrounds are told apart by the world, whatever is predicted."""

    def predict(images: torch.Tensor) -> SceneCode:
        assert images.dtype == torch.uint8
        code = brick_world.sample(len(images), (7,))
        contrast = images.float().flatten(1).std(dim=1) / 255
        return {**code, CONFIDENCE: contrast[:, None, None]}

    (answers,) = held_out_answers(brick_world, predict, "validation", 10, tmp_path)
    assert len(answers.confidences) == len(answers.without) == len(answers.errors) == 10
    assert answers.confidences.mean() > answers.without.mean()


def test_renderings_of_several_objects_are_also_those_without_some(brick: Object, tmp_path: Path) -> None:
    members = [replace(brick, kind=replace(brick.kind, name=name, slots=(slot,))) for slot, name in enumerate("ab")]
    layout = pose_layout(position_field(brick), confidence=True, num_slots=2)
    world = ObjectScenes("linemod", members, frame_camera(brick.camera), layout)

    def predict(images: torch.Tensor) -> SceneCode:
        code = world.sample(len(images), (7,))
        return {**code, CONFIDENCE: torch.tensor([0.2, 0.7]).repeat(len(images), 1)[..., None]}

    answers = held_out_answers(world, predict, "test", 20, tmp_path)
    assert [one.kind.name for one in answers] == ["a", "b"]
    assert all(len(one.confidences) + len(one.without) == 20 and len(one.without) for one in answers)
    assert [*answers[1].confidences, *answers[1].without] == pytest.approx([0.7] * 20)


def _reliability(name: str) -> Reliability:
    bounds = PoseBounds(min_confidence=0.3, lateral_m=0.01, depth_fraction=0.05, rotation_deg=10)
    return Reliability(
        level=0.9, num_images=9, objects=[ObjectReliability(object=name, min_confidence=0.3, bounds=[bounds])]
    )


def test_the_file_beside_a_model(circles_models: tuple[Exported, Exported], tmp_path: Path) -> None:
    folder = ModelFolder(tmp_path / "circles")
    shutil.copytree(circles_models[0].path.parent, folder.path)
    names = [kind.name for kind in open_model(folder.path).spec.objects]
    found = Reliability(level=0.9, objects=[_reliability(name).objects[0] for name in names])
    version = folder.versions()[-1]
    for _ in range(2):  # a second measurement takes the place of the first
        path = folder.put_beside(version, "reliability.json", json_format.MessageToJson(found))
    assert (folder.path / "SHA256SUMS").read_text().count("reliability.json") == 1
    assert path in folder.files()
    assert open_model(folder.path).spec.reliability == found
    path.write_text(path.read_text().replace("0.05", "0.06"))
    with pytest.raises(ModelError, match=r"reliability\.json has SHA-256"):
        open_model(folder.path)
    (folder.path / "SHA256SUMS").unlink()  # a list of this file alone would refuse the model
    folder.put_beside(version, "reliability.json", json_format.MessageToJson(found))
    assert open_model(folder.path).spec.reliability == found


def test_flat_worlds_have_no_intervals(circles_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The model is written all the same, and the message says so."""
    with pytest.raises(SystemExit) as exit_:
        export_command.export([str(circles_run), "--out", str(tmp_path), "--intervals"])
    assert exit_.value.code == 2
    told = " ".join(capsys.readouterr().err.split())
    assert "--intervals: world circles gives no poses in space" in told
    assert f"{tmp_path / 'circles'} was written" in told
