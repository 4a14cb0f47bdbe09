"""What is scored is what was learned: meshes, objects, results files and budgets that do not fit are refused."""

import json
from pathlib import Path

import pytest
import trimesh
from curio_train.commands.evaluate import evaluate as evaluate_command
from curio_train.config import Recipe, RunConfig
from curio_train.data.bop import LINEMOD_IDS
from curio_train.errors import DataError, UsageError
from curio_train.evaluation.real_frames import bop_file
from curio_train.evaluation.scores import mean_of_objects
from curio_train.evaluation.subject import Subject, load_subject
from curio_train.learning.runs.configuration import load_config
from curio_train.learning.runs.interruption import Interruption
from curio_train.learning.session import learn
from curio_train.worlds import build
from curio_train.worlds.options import LinemodOptions

MODELS = Path(__file__).resolve().parents[2] / "models"


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set in BOP's layout with an ape and a can of our own."""
    root = tmp_path_factory.mktemp("data") / "lm"
    (root / "models").mkdir(parents=True)
    for name, radius in (("ape", 40.0), ("can", 60.0)):
        trimesh.creation.icosphere(subdivisions=2, radius=radius).export(
            root / "models" / f"obj_{LINEMOD_IDS[name]:06}.ply"
        )
    known = {str(LINEMOD_IDS[name]): {"diameter": diameter} for name, diameter in (("ape", 80.0), ("can", 120.0))}
    (root / "models" / "models_info.json").write_text(json.dumps(known))
    camera = {"fx": 572.4, "fy": 573.6, "cx": 325.3, "cy": 242.0, "width": 640, "height": 480}
    (root / "camera.json").write_text(json.dumps(camera))
    return root


def test_a_model_is_scored_with_its_own_meshes_alone(data: Path) -> None:
    with pytest.raises(
        UsageError, match=r"--data .*: its mesh of ape is not the one that .*model.onnx was trained with"
    ):
        load_subject(MODELS / "ape", data)


def test_a_data_set_without_a_models_objects(data: Path) -> None:
    with pytest.raises(DataError, match="there is no mesh of cat here; found meshes of: ape can"):
        load_subject(MODELS / "lmo", data)


def test_a_run_whose_data_have_moved_is_scored_with_those_that_are_given(data: Path, tmp_path: Path, write_run) -> None:
    run = write_run(tmp_path / "run", LinemodOptions("ape", data, gaze=False))
    stored = json.loads((run / "config.json").read_text())
    stored["world"]["data"] = str(tmp_path / "gone")
    (run / "config.json").write_text(json.dumps(stored))
    assert load_subject(run, data).world.objects[0].name == "ape"
    with pytest.raises(DataError, match="gone"):
        load_subject(run)


def test_results_of_another_model_are_not_overwritten(data: Path, tmp_path: Path) -> None:
    options = LinemodOptions("ape", data, gaze=False)
    subject = Subject(RunConfig(options, method="wake_sleep"), build(options), lambda images: {}, 0, 0.0, "unknown")
    path = bop_file(tmp_path, subject, data)
    assert path == tmp_path / "wake-sleep_lm-test.csv"
    path.write_text("of another model")
    with pytest.raises(UsageError, match=r"wake-sleep_lm-test.csv is there already; remove it, or give another folder"):
        bop_file(tmp_path, subject, data)


def test_means_of_medians_are_called_so() -> None:
    each = [
        {"add_recall": 0.5, "rotation_deg_median": 10.0, "of_one": 1.0},
        {"add_recall": 0.7, "rotation_deg_median": 20.0},
    ]
    assert mean_of_objects(each) == pytest.approx({"add_recall": 0.6, "rotation_deg_median_mean": 15.0})


@pytest.mark.parametrize("path", ["nothing", "run"])
def test_nothing_is_downloaded_for_what_has_no_real_frames(
    path: str, tmp_path: Path, write_run, capsys: pytest.CaptureFixture[str]
) -> None:
    write_run(tmp_path / "run")
    with pytest.raises(SystemExit) as ended:
        evaluate_command([str(tmp_path / path), "--download", "--cache", str(tmp_path / "cache")])
    assert ended.value.code == 2
    expected = {"nothing": "there is no such file or folder", "run": "--download: world circles has no real frames"}
    assert expected[path] in capsys.readouterr().err
    assert not (tmp_path / "cache").exists()


def test_a_budget_that_drawing_uses_up_is_no_training(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("curio_train.data.backgrounds.POOL_SIZE", 10)
    config = RunConfig(LinemodOptions("ape", data, two_stage=True), method="sleep", minutes=1e-9)
    with pytest.raises(UsageError, match=r"--minutes 1e-09: drawing .* leaves nothing to learn in; give more"):
        learn(config, tmp_path / "run", Interruption(), resume=False, cache=tmp_path / "cache")
    assert load_config(tmp_path / "run").minutes == 1e-9


@pytest.mark.parametrize(
    ("flag", "value"),
    [
        ("image_weight", float("nan")),
        ("gradient_penalty", -5.0),
        ("sleep_noise", float("inf")),
        ("critic_weight", -1.0),
    ],
)
def test_weights_that_no_loss_can_have(flag: str, value: float) -> None:
    with pytest.raises(UsageError, match=f"--{flag.replace('_', '-')} is .*, expected 0 or more"):
        Recipe(**{flag: value})
    with pytest.raises(UsageError, match="--stop-below is nan, expected 0 or more"):
        RunConfig(LinemodOptions("ape"), stop_below=float("nan"))
