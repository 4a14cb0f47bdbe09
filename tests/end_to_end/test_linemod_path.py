"""The main job on real input: from a real mesh, without a label, to poses in real frames."""

import csv
import json
import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

if not os.environ.get("CURIO_DATA"):
    pytest.skip("CURIO_DATA is unset: no real data here", allow_module_level=True)

DATA = Path(os.environ.get("CURIO_DATA", "")) / "lmo"
FRAMES = DATA / "test" / "000002" / "rgb"
Call = Callable[..., object]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, call: Call) -> Path:
    folder = tmp_path_factory.mktemp("linemod")
    flags = [
        "--class",
        "ape",
        "--data",
        DATA,
        "--images",
        "64",
        "--out",
        folder / "run",
        "--cache",
        folder / "cache",
    ]
    call("curio-train", "linemod", *flags)
    return folder / "run"


@pytest.fixture(scope="module")
def model(run: Path, call: Call) -> Path:
    call("curio-export", run, "--out", run.parent / "models")
    return run.parent / "models" / "ape"


@pytest.fixture(scope="module")
def result(run: Path, call: Call) -> dict:
    flags = ["--data", DATA, "--bop-results", run.parent, "--num-images", "20", "--cache", run.parent / "cache"]
    return json.loads(call("curio-eval", run, *flags, "--json").stdout.splitlines()[-1])


def test_training_and_evaluation_leave_a_report(run: Path, result: dict) -> None:
    page = (run / "report.html").read_text()
    assert page.count('src="data:image/png;base64,') == 3
    assert f"{result['real']['metrics']['lateral_mm_median']:.4g}</td>" in page


def test_every_real_frame_gets_an_answer_and_a_drawing(model: Path, call: Call, tmp_path: Path) -> None:
    out = tmp_path / "found.jsonl"
    flags = ["--camera", DATA / "camera.json", "--out", out, "--overlays", tmp_path / "overlays"]
    call("curio-detect", model, FRAMES, *flags)
    frames = sorted(FRAMES.iterdir())
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [Path(row["image"]) for row in rows] == frames
    for row in rows:
        (found,) = row["detections"]
        assert found["object"] == "ape"
        rotation = np.array(found["rotation"])
        assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-5)
        assert found["translation_m"][2] > 0.2
    drawn = [cv2.imread(str(tmp_path / "overlays" / frame.name)) for frame in frames]
    assert all(picture is not None and picture.shape == (480, 640, 3) for picture in drawn)


def test_evaluation_sees_frames_as_serving_does(run: Path, model: Path, call: Call, tmp_path: Path) -> None:
    """The exported model's own results file against curio-detect's answers: two implementations of one view."""
    flags = ["--data", DATA, "--bop-results", tmp_path, "--num-images", "2", "--cache", run.parent / "cache"]
    call("curio-eval", model, *flags)
    with next(tmp_path.glob("*_lmo-test.csv")).open() as file:
        rows = list(csv.DictReader(file))
    done = call("curio-detect", model, FRAMES, "--camera", DATA / "camera.json")
    served = {int(Path(row["image"]).stem): row["detections"][0] for row in map(json.loads, done.stdout.splitlines())}
    assert len(rows) == 89
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


def test_a_model_needs_the_data_of_its_world(model: Path, call: Call) -> None:
    done = call("curio-eval", model, status=2)
    assert "needs its data: --data DIR" in done.stderr
