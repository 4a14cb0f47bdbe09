"""The main job on real input: from a real mesh, without a label, to poses in real frames.

Most of it with --two-stage, whose whole frames are read in a tenth of the time; then as the command does by default.
"""

import csv
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from curio_train.commands.evaluate import evaluate
from curio_train.commands.export import export
from curio_train.commands.train import train
from curio_train.data import backgrounds
from curio_train.evaluation import evaluate as evaluation
from curio_train.evaluation.reporting import report
from curio_train.export import graph
from curio_train.learning.runs.configuration import load_config
from curio_train.networks.templates import geometry
from curio_train.worlds import build
from curio_train.worlds.several_objects import confidence as confidence_of_several
from curio_train.worlds.several_objects.world import SeveralObjectsWorld
from curio_train.worlds.single_object import confidence

if not os.environ.get("CURIO_DATA"):
    pytest.skip("CURIO_DATA is unset: no real data here", allow_module_level=True)

DATA = Path(os.environ.get("CURIO_DATA", "")) / "lmo"
FRAMES = DATA / "test" / "000002" / "rgb"
TARGETS, APE_ID = "test_targets_bop19.json", 1
Call = Callable[..., "subprocess.CompletedProcess[str]"]
APE = ["linemod", "--class", "ape", "--data", DATA]
SMALL = ["--images", "16", "--batch-size", "8", "--micro-batch-size", "8"]


def status_of(command: Callable[[list[str]], None], *arguments: object) -> int | str | None:
    """Exit status of a command in this process, which spares some ten seconds of imports a call."""
    with pytest.raises(SystemExit) as exit_:
        command([str(word) for word in arguments])
    return exit_.value.code


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Where runs, models and caches are; meanwhile few whole frames are rendered and read beside those asked for."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(backgrounds, "POOL_SIZE", 10)
        patch.setattr(confidence, "NUM_FRAMES", 5)
        patch.setattr(confidence, "_BATCH_SIZE", 5)
        patch.setattr(evaluation, "_BATCH_SIZE", 10)
        patch.setattr(evaluation, "_NUM_EMPTY", 10)
        patch.setattr(graph, "_NUM_CHECK_IMAGES", 2)
        patch.setattr(graph, "NUM_JITTERED", 2)
        patch.setattr(report, "_NUM_COMPARED", 6)
        yield tmp_path_factory.mktemp("linemod")


@pytest.fixture(scope="module")
def run(folder: Path) -> Path:
    words = [*APE, "--two-stage", "--out", folder / "run", "--cache", folder / "cache", *SMALL]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["curio-train", *map(str, words)])  # which the model's card names
        assert status_of(train, *words) == 0
    return folder / "run"


@pytest.fixture(scope="module")
def model(run: Path) -> Path:
    assert status_of(export, run, "--out", run.parent / "models") == 0
    return run.parent / "models" / "ape"


@pytest.fixture(scope="module")
def result(run: Path) -> dict[str, Any]:
    flags = ["--data", DATA, "--bop-results", run.parent, "--num-images", "20", "--cache", run.parent / "cache"]
    assert status_of(evaluate, run, *flags) == 0
    return json.loads((run / "evaluation.json").read_text())


@pytest.fixture(scope="module")
def fifth(folder: Path) -> Path:
    """The data with every fifth frame in FOLDER/frames and the targets of these, as reading all takes longer."""
    data, frames = folder / "lmo", folder / "frames"
    data.mkdir()
    frames.mkdir()
    for path in DATA.iterdir():
        (data / path.name).symlink_to(path)
    chosen = sorted(FRAMES.iterdir())[::5]
    for path in chosen:
        (frames / path.name).symlink_to(path)
    targets = json.loads((DATA / TARGETS).read_text())
    numbers = {int(path.stem) for path in chosen}
    (data / TARGETS).unlink()
    (data / TARGETS).write_text(json.dumps([target for target in targets if target["im_id"] in numbers]))
    return data


@pytest.fixture(scope="module")
def detected(folder: Path, fifth: Path, model: Path, call: Call) -> list[dict[str, Any]]:
    """What curio-detect finds in each of these frames, with drawings in FOLDER/overlays."""
    flags = ["--camera", DATA / "camera.json", "--overlays", folder / "overlays"]
    done = call("curio-detect", model, folder / "frames", *flags)
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_training_and_evaluation_leave_a_report(run: Path, result: dict) -> None:
    page = (run / "report.html").read_text()
    assert all(f'<img id="{name}"' in page for name in ("samples", "histograms", "curves"))
    assert f"{result['real']['metrics']['lateral_mm_median']:.4g}</td>" in page


def test_every_real_frame_gets_an_answer_and_a_drawing(folder: Path, detected: list[dict[str, Any]]) -> None:
    frames = sorted((folder / "frames").iterdir())
    assert len(frames) == 20
    assert [Path(row["image"]) for row in detected] == frames
    for row in detected:
        (found,) = row["detections"]
        assert found["object"] == "ape"
        rotation = np.array(found["rotation"])
        assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-5)
        assert found["translation_m"][2] > 0.2
    drawn = [cv2.imread(str(folder / "overlays" / frame.name)) for frame in frames]
    assert all(picture is not None and picture.shape == (480, 640, 3) for picture in drawn)


def test_evaluation_sees_frames_as_serving_does(
    model: Path, detected: list[dict[str, Any]], fifth: Path, folder: Path, tmp_path: Path
) -> None:
    """The exported model's own results file against curio-detect's answers: two implementations of one view."""
    flags = ["--data", fifth, "--bop-results", tmp_path, "--num-images", "2", "--cache", folder / "cache"]
    assert status_of(evaluate, model, *flags) == 0
    with next(tmp_path.glob("*_lmo-test.csv")).open() as file:
        rows = list(csv.DictReader(file))
    served = {int(Path(row["image"]).stem): row["detections"][0] for row in detected}
    targets = json.loads((fifth / TARGETS).read_text())
    assert [int(row["im_id"]) for row in rows] == [target["im_id"] for target in targets if target["obj_id"] == APE_ID]
    assert len(rows) > 15
    for row in rows:
        found = served[int(row["im_id"])]
        assert np.array(row["t"].split(), float) / 1000 == pytest.approx(found["translation_m"], abs=1e-4)
        rotation = np.array(row["R"].split(), float).reshape(3, 3)
        assert rotation == pytest.approx(np.array(found["rotation"]), abs=1e-3)


def test_real_targets_are_counted_by_visibility(result: dict) -> None:
    bins = {(row["from"], row["to"]): row["num_targets"] for row in result["real"]["by_visibility"]}
    assert sum(bins.values()) == 89
    assert bins[0.8, 1.0] == result["real"]["num_targets_visible_80"] == 58  # as published with the data
    assert 0 <= result["real"]["metrics"]["add_recall_visible_80"] <= 1
    assert (result["real"]["split_name"], result["labels_synthetic"]) == ("bop19 targets", True)
    for metrics in (result["metrics"], result["untrained"], result["real"]["metrics"]):
        assert 0 <= metrics["add_recall"] <= 1
        assert 0 <= metrics["rotation_deg_median"] <= 180
        assert metrics["translation_mm_median"] >= metrics["lateral_mm_median"]


def test_the_card_names_the_meshes_and_no_folder_of_this_machine(model: Path) -> None:
    card = (model / "CARD.md").read_text()
    assert "Linemod-Occluded (Brachmann et al. 2014)" in card
    assert "CC BY-SA 4.0" in card
    assert "--data lmo" in card
    assert str(DATA.parent) not in card


def test_a_model_needs_the_data_of_its_world(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert status_of(evaluate, model) == 2
    assert "needs its data: --data DIR" in capsys.readouterr().err


def test_by_default_a_locator_and_templates_find_the_object(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """How such networks are exported is tested with several objects."""
    monkeypatch.setattr(confidence_of_several, "NUM_FRAMES", 4)
    monkeypatch.setattr(geometry, "NUM_VIEWS", 24)
    run = folder / "located"
    assert status_of(train, *APE, "--out", run, "--cache", folder / "cache", *SMALL) == 0
    world = build(load_config(run).world)
    assert isinstance(world, SeveralObjectsWorld)
    assert world.model_name == "ape"
    assert status_of(evaluate, run, "--num-images", "4", "--cache", folder / "cache") == 0
    assert {"add_recall", "confidence_ece"} <= json.loads((run / "evaluation.json").read_text())["metrics"].keys()
