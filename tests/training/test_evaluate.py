"""Scores on cases worked out by hand, on real frames of a small data set, and what an evaluation refuses."""

import io
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from curio_train.commands import evaluate as evaluate_command
from curio_train.config import RunConfig
from curio_train.data.bop import ModelInfo
from curio_train.errors import CurioError, DataError, ExportError, UsageError
from curio_train.evaluation.evaluate import draw, evaluate, score
from curio_train.evaluation.real_frames import evaluate_real_frames, refuse_unscorable
from curio_train.evaluation.repeated import reading_repeatedly
from curio_train.evaluation.reporting.tables import print_evaluation
from curio_train.evaluation.scores import pose_scores, rotation_errors_deg, scene_errors
from curio_train.evaluation.several_objects import several_objects_scores
from curio_train.evaluation.subject import Subject
from curio_train.geometry import Pose, matrix_from_rotation_6d, rotation_6d_from_matrix
from curio_train.scene_code import CONFIDENCE, LIGHT, PRESENCE, ROTATION_6D, TRANSLATION
from curio_train.worlds.generated.circles import Circles
from curio_train.worlds.linemod import build
from curio_train.worlds.options import LinemodOptions
from curio_train.worlds.several_objects.world import SeveralObjectsWorld
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.world import Object, SingleObjectWorld
from rich.console import Console
from scipy.spatial.transform import Rotation

WriteRun = Callable[..., Path]


def turned(axis: str, degrees: float) -> np.ndarray:
    return Rotation.from_euler(axis, degrees, degrees=True).as_matrix()


def test_circles_are_scored_in_image_widths_and_pixels() -> None:
    world = Circles()
    code = world.sample(4, (0,))
    offset = torch.tensor([[0.03, -0.04, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.3, 0.4, 0.0]])[:, None]
    found = score(world, {TRANSLATION: code[TRANSLATION] + offset}, code)
    assert found["position_image_widths"] == pytest.approx((0.05 + 0.5) / 4, rel=1e-5)
    assert found["position_px"] == pytest.approx(128 * (0.05 + 0.5) / 4, rel=1e-5)
    assert found["scene_error"] == pytest.approx((0.05 + 0.5) / 4 / 0.8, rel=1e-5)  # Eq. 1 divides by the range
    perfect = score(world, code, code)
    assert perfect.keys() == found.keys()
    assert all(value == pytest.approx(0, abs=1e-6) for value in perfect.values())


def test_held_out_images_are_bytes_and_at_most_what_there_is(tmp_path: Path) -> None:
    world = Circles()
    some = draw(world, "test", 70, tmp_path)
    assert (some.images.shape, some.images.dtype) == ((70, 3, 128, 128), torch.uint8)
    assert some.code[TRANSLATION].shape == (70, 1, 3)
    rendered = (world.render({TRANSLATION: some.code[TRANSLATION][60:]}) * 255).round().byte()
    assert torch.equal(rendered, some.images[60:])
    assert len(draw(world, "test", 10_000, tmp_path).images) == 500


CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.05
DIAMETER_M = 0.1 * np.sqrt(3)


def test_poses_are_scored_beside_their_errors() -> None:
    truth = Pose(np.eye(3), np.array([0.0, 0.0, 1.0]))
    near = Pose(np.eye(3), np.array([0.003, 0.004, 1.012]))  # 13 mm of 17.3 allowed
    far = Pose(turned("z", 90), np.array([0.006, 0.008, 0.976]))
    found = pose_scores([truth, near, far], [truth] * 3, CUBE, ModelInfo(DIAMETER_M))
    assert found == pytest.approx(
        {
            "add_recall": 2 / 3,
            "rotation_deg_median": 0.0,
            "translation_mm_median": 13.0,
            "lateral_mm_median": 5.0,
            "depth_mm_median": 12.0,
        },
        abs=1e-4,
    )


def test_turns_that_look_alike_are_no_errors() -> None:
    quarter = np.eye(4)
    quarter[:3, :3] = turned("z", 90)
    half = np.eye(4)
    half[:3, :3] = turned("z", 180)
    discrete = ModelInfo(DIAMETER_M, symmetries=(quarter, half))
    around = ModelInfo(DIAMETER_M, symmetry_axes=((np.array([0.0, 0.0, 1.0]), np.zeros(3)),))
    pose = turned("x", 37)
    truth = [Pose(pose, np.zeros(3))] * 3
    estimates = [Pose(pose @ turned("z", angle), np.zeros(3)) for angle in (90.0, 100.0, 270.0)]
    assert rotation_errors_deg(estimates, truth, ModelInfo(DIAMETER_M)) == pytest.approx([90, 100, 90], abs=1e-3)
    assert rotation_errors_deg(estimates, truth, discrete) == pytest.approx([0, 10, 90], abs=1e-3)
    assert rotation_errors_deg(estimates, truth, around) == pytest.approx([0, 0, 0], abs=0.6)  # half a step
    ball = ModelInfo(DIAMETER_M, symmetry_axes=tuple((axis, np.zeros(3)) for axis in np.eye(3)[:2]))
    assert rotation_errors_deg(estimates, truth, ball) == pytest.approx([0, 0, 0], abs=1e-6)


def test_a_pose_that_looks_alike_has_no_scene_error(brick_world: TwoStageWorld) -> None:
    """Half a turn of the brick, which is not told from none, and a quarter, which is."""
    true = brick_world.sample(3, (1,))
    turns = torch.from_numpy(np.stack([turned("z", angle) for angle in (180.0, 90.0, 0.0)])).float()
    rotation = matrix_from_rotation_6d(true[ROTATION_6D][:, 0]) @ turns
    predicted = {**true, ROTATION_6D: rotation_6d_from_matrix(rotation)[:, None]}
    errors = scene_errors(brick_world, predicted, true)
    assert errors["rotation_deg"].tolist() == pytest.approx([0, 90, 0], abs=0.1)
    assert errors["scene_error"].tolist() == pytest.approx([0, errors["scene_error"][1].item(), 0], abs=1e-3)
    assert errors["scene_error"][1] > 0.1
    assert float(brick_world.code_loss(predicted, true)) == pytest.approx(float(errors["scene_error"].mean()))


def test_renderings_that_show_nothing_are_too_few(brick: Object) -> None:
    world = SeveralObjectsWorld("linemod", [brick])
    code = world.sample(2, (1,))
    code[CONFIDENCE][:] = 0
    with pytest.raises(UsageError, match="--num-images 2: none of them shows an object"):
        several_objects_scores(world, code, code)


def test_presence_tells_what_is_shown_and_confidence_where_there_is_none(brick: Object) -> None:
    world = SeveralObjectsWorld("linemod", [brick])
    true = world.sample(4, (1,))
    true[CONFIDENCE][:, 0, 0] = torch.tensor([1.0, 1.0, 0.0, 0.0])
    found = {**true, CONFIDENCE: torch.tensor([0.1, 0.2, 0.3, 0.4])[:, None, None]}
    assert several_objects_scores(world, found, true)["present_auroc"] == 0
    assert several_objects_scores(world, {**found, PRESENCE: 1 - found[CONFIDENCE]}, true)["present_auroc"] == 1


K = [572.4, 0, 325.3, 0, 573.6, 242.0, 0, 0, 1]
TRUTHS = {3: ([0.0, 0.0, 800.0], 1.0), 4: ([60.0, 0.0, 900.0], 0.5), 9: ([0.0, 0.0, 700.0], 0.9)}  # mm, visible


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Three real frames of a box, of which BOP asks for two."""
    root = tmp_path / "lmx"
    scene = root / "test" / "000002"
    (scene / "rgb").mkdir(parents=True)
    (root / "models").mkdir()
    trimesh.creation.box((80, 80, 80)).export(root / "models" / "obj_000001.ply")
    (root / "models" / "models_info.json").write_text(json.dumps({"1": {"diameter": 80 * np.sqrt(3)}}))
    camera = {"fx": K[0], "fy": K[4], "cx": K[2], "cy": K[5], "width": 640, "height": 480}
    (root / "camera.json").write_text(json.dumps(camera))
    for number in TRUTHS:
        cv2.imwrite(str(scene / "rgb" / f"{number:06d}.png"), np.full((480, 640, 3), number, np.uint8))
    rows = {
        number: [{"cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": place, "obj_id": 1}]
        for number, (place, _) in TRUTHS.items()
    }
    (scene / "scene_gt.json").write_text(json.dumps(rows))
    (scene / "scene_gt_info.json").write_text(json.dumps({n: [{"visib_fract": v}] for n, (_, v) in TRUTHS.items()}))
    (scene / "scene_camera.json").write_text(json.dumps({number: {"cam_K": K} for number in TRUTHS}))
    targets = [{"scene_id": 2, "im_id": number, "obj_id": 1, "inst_count": 1} for number in (3, 4)]
    (root / "test_targets_bop19.json").write_text(json.dumps(targets))
    return root


def always_at(world: SingleObjectWorld, translation_m: list[float]) -> Subject:
    """A reader that sees the object at one place of the canonical camera, whatever it is shown."""

    def predict(images: torch.Tensor) -> dict[str, torch.Tensor]:
        count = len(images)
        assert images.shape == (count, 3, 128, 128)
        return {
            TRANSLATION: torch.tensor(translation_m).expand(count, 1, 3),
            ROTATION_6D: torch.tensor([1.0, 0, 0, 0, 1, 0]).expand(count, 1, 6),
            LIGHT: torch.zeros(count, 3),
        }

    config = RunConfig(LinemodOptions("ape", Path()), method="wake_sleep")
    return Subject(config, world, predict, 0, 0.0, "")


def test_real_frames_are_scored_where_bop_asks(data: Path, tmp_path: Path) -> None:
    world = build(LinemodOptions("ape", data, gaze=False))
    found = evaluate_real_frames(always_at(world, [0.0, 0.0, 0.8]), data, tmp_path / "bop")
    assert (found["dataset"], found["split"], found["num_targets"]) == ("lmx", "test", 2)
    assert found["split_name"] == "bop19 targets"
    metrics = found["metrics"]
    assert metrics["add_recall"] == 0.5  # right in image 3; in image 4 it is 117 mm off
    assert metrics["add_recall_low"] <= 0.5 <= metrics["add_recall_high"]
    assert metrics["rotation_deg_median"] == pytest.approx(0, abs=0.05)
    assert metrics["translation_mm_median"] == pytest.approx(np.hypot(60, 100) / 2, rel=1e-3)
    assert metrics["mssd_recall"] == 0.5
    assert metrics["confidence_ece"] == 0.5  # sure of both
    # In image 4 the farthest corner is at (13.3, ±26.7) px from the centre and found at (-30.1, ±30.2): 43.6 px off,
    # below two of the ten thresholds.
    assert metrics["mspd_recall"] == pytest.approx((1 + 0.2) / 2)
    assert found["by_visibility"] == [
        {"from": 0.4, "to": 0.6, "num_targets": 1, "add_recall": 0.0},
        {"from": 0.8, "to": 1.0, "num_targets": 1, "add_recall": 1.0},
    ]

    assert found["num_targets_visible_80"] == 1
    names = ("add_recall_visible_80", "add_recall_visible_80_low", "add_recall_visible_80_high")
    assert [metrics[name] for name in names] == [1.0, 1.0, 1.0]
    right, wrong = found["targets"]
    assert (right["image_id"], right["visible_fraction"], right["confidence"]) == (3, 1.0, 1.0)
    assert right["add_diameters"] < 0.01
    assert (wrong["image_id"], wrong["visible_fraction"]) == (4, 0.5)
    assert wrong["translation_mm"] == pytest.approx(np.hypot(60, 100), rel=1e-3)
    assert wrong["add_diameters"] == pytest.approx(np.hypot(60, 100) / 80 / np.sqrt(3), rel=1e-2)

    header, *lines = (tmp_path / "bop" / "wake-sleep_lmx-test.csv").read_text().splitlines()
    assert header == "scene_id,im_id,obj_id,score,R,t,time"
    rows = [line.split(",") for line in lines]
    assert [row[:4] for row in rows] == [["2", "3", "1", "1"], ["2", "4", "1", "1"]]
    for row in rows:
        assert np.array(row[4].split(), float) == pytest.approx(np.eye(3).ravel(), abs=1e-3)
        assert np.array(row[5].split(), float) == pytest.approx([0, 0, 800], abs=0.5)
        assert float(row[6]) > 0


def test_a_ball_is_found_however_it_is_turned(data: Path) -> None:
    trimesh.creation.icosphere(radius=40).export(data / "models" / "obj_000001.ply")
    axes = [{"axis": axis, "offset": [0, 0, 0]} for axis in ([0, 0, 1], [1, 0, 0])]
    info = {"1": {"diameter": 80, "symmetries_continuous": axes}}
    (data / "models" / "models_info.json").write_text(json.dumps(info))
    labels = data / "test/000002/scene_gt.json"
    rows = json.loads(labels.read_text())
    rows["3"][0]["cam_R_m2c"] = Rotation.from_euler("xyz", [70, 80, 100], degrees=True).as_matrix().ravel().tolist()
    labels.write_text(json.dumps(rows))
    world = build(LinemodOptions("ape", data, gaze=False))
    found = evaluate_real_frames(always_at(world, [0.0, 0.0, 0.8]), data, None)
    assert found["targets"][0]["rotation_deg"] == 0
    assert found["metrics"]["mssd_recall"] == 0.5  # image 4 is 117 mm off
    assert found["metrics"]["mspd_recall"] >= 0.5


def test_what_agrees_in_several_reads_is_scored(data: Path) -> None:
    """Whatever the camera: an object that is always read there is where the mean of the reads is."""
    world = build(LinemodOptions("ape", data, gaze=False))
    subject = reading_repeatedly(always_at(world, [0.0, 0.0, 0.8]), 5)
    images = torch.zeros(2, 3, world.camera.height, world.camera.width, dtype=torch.uint8)
    code = subject.predict(images)
    assert code[TRANSLATION].shape == (2, 1, 3)
    np.testing.assert_allclose(code[TRANSLATION][0, 0], [0, 0, 0.8], atol=0.01)
    with pytest.raises(UsageError, match="--reads: reads is 10; expected 1 to 9"):
        reading_repeatedly(subject, 10)


def test_visible_targets_are_left_out_where_nothing_is_known_of_them(data: Path) -> None:
    world = build(LinemodOptions("ape", data, gaze=False))
    (data / "test/000002/scene_gt_info.json").unlink()
    found = evaluate_real_frames(always_at(world, [0.0, 0.0, 0.8]), data, None)
    assert found["num_targets_visible_80"] == 0
    assert "add_recall_visible_80" not in found["metrics"]


def test_a_data_set_without_the_object_is_refused(data: Path) -> None:
    world = build(LinemodOptions("ape", data, gaze=False))
    for file in (data / "test").rglob("*.png"):
        file.unlink()
    with pytest.raises(DataError, match="found no images"):
        evaluate_real_frames(always_at(world, [0.0, 0.0, 0.8]), data, None)
    (data / "test_targets_bop19.json").write_text("[]")
    with pytest.raises(DataError, match="found no labelled frame of ape"):
        evaluate_real_frames(always_at(world, [0.0, 0.0, 0.8]), data, None)
    with pytest.raises(DataError, match="found no labelled frame of ape"):
        refuse_unscorable(world, data)
    with pytest.raises(DataError, match="there is no such folder"):
        refuse_unscorable(world, data / "none")


def test_the_command_prints_one_object_and_keeps_it(
    tmp_path: Path, write_run: WriteRun, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write_run(tmp_path / "run")
    with pytest.raises(SystemExit) as exit_:
        evaluate_command.evaluate([str(run), "--json", "--num-images", "40", "--cache", str(tmp_path / "cache")])
    assert exit_.value.code == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert json.loads((run / "evaluation.json").read_text()) == result
    assert (result["world"], result["method"], result["seed"], result["num_images"]) == ("circles", "noncur", 3, 40)
    assert (result["labels_real"], result["labels_synthetic"]) == (False, False)
    assert (result["images_seen"], result["labels"], result["objects"]) == (64, 0.0, ["circle"])
    assert result["metrics"].keys() == result["untrained"].keys()
    assert result["metrics"] != result["untrained"]


@pytest.mark.parametrize(
    ("argument", "error", "text"),
    [
        ("nowhere", UsageError, "there is no such file or folder"),
        ("empty", UsageError, "neither a run folder .* nor a model"),
        ("text.onnx", ExportError, "text.onnx is not an ONNX file"),
    ],
)
def test_what_is_no_run_and_no_model_is_refused(
    tmp_path: Path, argument: str, error: type[CurioError], text: str
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.onnx").write_text("not a graph")
    with pytest.raises(error, match=text):
        evaluate(tmp_path / argument, cache=tmp_path)


def test_flags_that_make_no_sense_are_refused(tmp_path: Path, write_run: WriteRun) -> None:
    run = write_run(tmp_path / "run")
    with pytest.raises(UsageError, match="--num-images is 0"):
        evaluate(run, num_images=0, cache=tmp_path)
    with pytest.raises(UsageError, match="--bop-results needs"):
        evaluate(run, bop_results=tmp_path, cache=tmp_path)
    with pytest.raises(UsageError, match=r"--data .*: world circles has no real frames"):
        evaluate(run, data=tmp_path, cache=tmp_path)


def test_refined_poses_stand_beside_those_as_read(data: Path, tmp_path: Path) -> None:
    world = build(LinemodOptions("ape", data, gaze=False))
    as_read = evaluate_real_frames(always_at(world, [0.0, 0.0, 0.8]), data, tmp_path)
    better = evaluate_real_frames(always_at(world, [0.06, 0.0, 0.9]), data, tmp_path, "-refined")
    assert {file.name for file in tmp_path.glob("*.csv")} == {
        "wake-sleep_lmx-test.csv",
        "wake-sleep-refined_lmx-test.csv",
    }
    result = {
        "source": "ape", "world": "linemod", "objects": ["ape"], "method": "sleep", "preset": "laptop", "seed": 0,
        "images_seen": 10, "training_seconds": 60.0, "split": "test", "num_images": 5,
        "metrics": {"add_recall": 0.25}, "untrained": {"add_recall": 0.125}, "real": as_read,
    }  # fmt: skip
    console = Console(record=True, width=120, file=io.StringIO())
    print_evaluation(result, console)
    assert "refined" not in console.export_text()
    print_evaluation(result | {"refined": {"metrics": {"add_recall": 0.75}, "real": better}}, console)
    rows = [[cell.strip() for cell in line.split("│")] for line in console.export_text().splitlines()]
    assert ["ADD(-S) below 0.1 diameters, fraction", "0.25", "0.125", "0.75"] in [row[1:-1] for row in rows]
    seen = next(row for row in rows if "40–60 % visible" in "".join(row))
    assert seen[2:4] == ["0", "1"]


def test_no_table_has_means_and_medians() -> None:
    metrics = {"rotation_deg": 5.0, "rotation_deg_median": 3.0, "add_recall": 0.5}
    result = {
        "source": "ape", "world": "linemod", "objects": ["ape"], "method": "sleep", "preset": "laptop", "seed": 0,
        "images_seen": 10, "training_seconds": 60.0, "split": "test", "num_images": 5,
        "metrics": metrics, "untrained": metrics,
    }  # fmt: skip
    console = Console(record=True, width=120, file=io.StringIO())
    print_evaluation(result, console)
    means, medians = console.export_text().split("5 images of the test split: ")[1:]
    assert means.split("\n")[0].strip() == "means and fractions"
    assert "rotation, degrees " in means
    assert "median" not in means
    assert medians.split("\n")[0].strip() == "medians"
    assert "rotation, degrees, median" in medians
    assert "ADD(-S)" not in medians
