"""LineMOD's table on runs and a real data set of our own: scored once, kept, told as a page, drawn as a sheet."""

import copy
import dataclasses
import importlib.util
import json
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from curio_train.data.bop import LINEMOD_CLASSES
from curio_train.errors import DataError, UsageError
from curio_train.evaluation import evaluate
from curio_train.evaluation.unlabelled.candidates import candidates
from curio_train.worlds.options import LinemodOptions
from paper.linemod_markdown import markdown
from paper.linemod_table import load_table
from paper.paper_tables import LINEMOD
from paper.results import Results

ROOT = Path(__file__).parents[2]
K = [572.4, 0, 325.3, 0, 573.6, 242.0, 0, 0, 1]
WriteRun = Callable[..., Path]


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    spec = importlib.util.spec_from_file_location("linemod_benchmark", ROOT / "benchmarks" / "linemod.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("linemod")


@pytest.fixture(scope="module")
def data(folder: Path) -> Path:
    """Two frames of a box; of the first nothing is hidden."""
    root, scene = folder / "lmx", folder / "lmx" / "test" / "000002"
    for place in (scene / "rgb", root / "models", folder / "photographs"):
        place.mkdir(parents=True)
    trimesh.creation.box((80, 60, 40)).export(root / "models" / "obj_000001.ply")
    (root / "models" / "models_info.json").write_text(json.dumps({"1": {"diameter": 107.7}}))
    camera = {"fx": K[0], "fy": K[4], "cx": K[2], "cy": K[5], "width": 640, "height": 480}
    (root / "camera.json").write_text(json.dumps(camera))
    truth = {"cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [0, 0, 800], "obj_id": 1}
    other = {**truth, "obj_id": 5}
    (scene / "scene_gt.json").write_text(json.dumps({"3": [truth, other], "4": [truth]}))
    info = {"3": [{"visib_fract": 0.9}, {"visib_fract": 0.1}], "4": [{"visib_fract": 0.2}]}
    (scene / "scene_gt_info.json").write_text(json.dumps(info))
    (scene / "scene_camera.json").write_text(json.dumps({"3": {"cam_K": K}, "4": {"cam_K": K}}))
    random = np.random.default_rng(0)
    for number in (3, 4):
        cv2.imwrite(str(scene / "rgb" / f"{number:06d}.png"), np.full((480, 640, 3), 90, np.uint8))
        picture = random.integers(0, 90, (96, 96, 3), dtype=np.uint8)
        cv2.imwrite(str(folder / "photographs" / f"{number}.png"), picture)
    return root


@pytest.fixture(scope="module")
def settings(folder: Path, data: Path, benchmark: ModuleType, write_run: WriteRun) -> Iterator[Any]:
    """Few frames are rendered: none in a batch beyond those that are scored, and as many without the object."""
    options = LinemodOptions("ape", data, folder / "photographs", gaze=False)
    write_run(folder / "runs" / "first", options=options)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluate, "_BATCH_SIZE", 4)
        patch.setattr(evaluate, "_NUM_EMPTY", 4)
        yield benchmark.Settings(
            runs=folder / "runs",
            data=data,
            frames=data,
            sheets=folder / "sheets",
            num_images=4,
            results=folder / "linemod.json",
            cache=folder / "cache",
        )


@pytest.fixture(scope="module")
def table(settings: Any, folder: Path, benchmark: ModuleType) -> Results:
    assert benchmark.main(settings) == 0
    return load_table(folder / "linemod.json")


def test_a_row_holds_rendered_and_real_figures(table: Results, folder: Path) -> None:
    row = table["noncur"]["ape"]
    assert (row["labels_real"], row["labels_synthetic"], row["images_seen"], row["num_images"]) == (False, False, 64, 4)
    assert {"add_recall", "rotation_deg_median", "translation_mm_median"} <= row["rendered"].keys()
    real = row["real"]
    assert (real["dataset"], real["split_name"]) == ("lmx", "all labelled frames")
    assert (real["num_targets"], real["num_targets_visible_80"]) == (2, 1)
    assert [frame["image_id"] for frame in row["frames"]] == [3, 4]
    assert str(folder) not in (folder / "linemod.json").read_text()
    assert str(folder) not in (folder / "linemod.md").read_text()


def test_the_sheet_has_a_column_a_frame_that_is_seen_well(table: Results, folder: Path) -> None:
    sheet = cv2.imread(str(folder / "sheets" / "ape-noncur.png"))
    assert sheet is not None
    assert sheet.shape == (320, 160, 3)
    green = (sheet[..., 1].astype(int) - sheet[..., 2] > 60).any(axis=1)
    assert green[:160].any()
    assert not green[160:].any()
    assert (sheet[:160] == 90).mean() > 0.5, "the frame itself is not to be seen"


def test_refined_rows_stand_beside_unless_left_out(
    table: Results, settings: Any, folder: Path, benchmark: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    assert table.keys() == {"noncur", "noncur, refined"}
    alone = dataclasses.replace(settings, refine=False, sheets=None, results=folder / "alone.json")
    for kept in (False, True):
        assert benchmark.main(alone) == 0
        assert ("first: kept" in capsys.readouterr().err) is kept
        assert load_table(alone.results).keys() == {"noncur"}


def test_a_class_is_kept_until_something_it_is_made_of_changes(
    table: Results, settings: Any, folder: Path, benchmark: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    marked = copy.deepcopy(table)
    marked["noncur"]["ape"]["machine"] = "of the first time"
    (folder / "linemod.json").write_text(json.dumps(marked))
    benchmark.main(settings)
    assert "first: kept" in capsys.readouterr().err
    assert load_table(folder / "linemod.json") == marked
    (candidate,) = candidates(folder / "runs")
    row = table["noncur"]["ape"]
    assert benchmark.is_current(row, candidate, 4, settings.data)
    assert not benchmark.is_current(row, candidate, 5, settings.data)
    assert not benchmark.is_current(row | {"weights_sha256": ""}, candidate, 4, settings.data)
    assert not benchmark.is_current(row | {"real_sha256": ""}, candidate, 4, settings.data)
    assert not benchmark.is_current(None, candidate, 4, settings.data)


def test_folders_without_or_with_two_runs_of_a_class_are_refused(table: Results, folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="found no run folder and no model of linemod"):
        candidates(tmp_path)
    for name in ("one", "two"):
        shutil.copytree(folder / "runs" / "first", tmp_path / name)
    with pytest.raises(UsageError, match="found one and two, both ape by noncur; expected one run"):
        candidates(tmp_path)


def figures(name: str, share: float, visible: float, num_visible: int) -> dict[str, object]:
    metrics = {"rotation_deg_median": 5.0, "translation_mm_median": 9.0}
    for metric, value in (("add_recall", share), ("add_recall_visible_80", visible)):
        metrics |= {metric: value, f"{metric}_low": value - 0.1, f"{metric}_high": value + 0.1}
    real = {"dataset": "lmo", "split_name": "bop19 targets", "num_targets": 90, "metrics": metrics}
    rendered = {"add_recall": 0.8, "rotation_deg_median": 4.0, "translation_mm_median": 7.0, "confidence_ece": 0.05}
    made = {
        "num_images": 1500,
        "images_seen": 1000,
        "training_seconds": 120,
        "machine": "M",
        "labels_real": False,
        "labels_synthetic": True,
    }
    return {**made, "rendered": rendered, "real": real | {"num_targets_visible_80": num_visible}, "frames": []}


def line(page: str, start: str) -> list[str]:
    found = next(line for line in page.splitlines() if line.startswith(f"| {start}"))
    return [cell.strip() for cell in found.strip("|").split("|")]


def test_published_figures_stand_beside_rows_of_the_same_frames_only() -> None:
    rows = {"ape": figures("ape", 0.4, 0.5, 58), "cat": figures("cat", 0.2, 0.3, 52)}
    page = markdown({"sleep": rows}, "make it")
    assert "Labels of real images: no; of renderings: yes. 1,500 renderings a class." in page
    assert line(page, "ape")[8:14] == ["40.0 (30–50)", "90", "46.1", "50.0 (40–60)", "58", "65.5"]
    mean = line(page, "**mean of 2**")
    assert [mean[3], mean[6], mean[7]] == ["80.0", "0.050", "–"]
    assert [mean[8], mean[10], mean[11], mean[13]] == ["30.0", "41.8", "40.0", "58.7"]
    ours = line(page, "**here: `sleep`**, lmo, all targets, mean of 2")
    assert ours[1:6] == ["no", "yes", "30.0", "40.0", "–"]
    assert line(page, "Our |")[1:5] == ["no", "no", "60.9", "50.2"]

    elsewhere = markdown({"sleep": {**rows, "cat": figures("cat", 0.2, 0.3, 51)}}, "make it")
    assert line(elsewhere, "cat")[10] == "–"
    assert line(elsewhere, "**mean of 2**")[10] == "–", "a mean of other classes than ours"


def test_the_papers_means_are_those_of_its_classes() -> None:
    for name, row in LINEMOD.items():
        assert len(row.classes) == len(LINEMOD_CLASSES), name
        assert sum(row.classes) / len(row.classes) == pytest.approx(row.mean, abs=0.11), name


def test_networks_that_saw_real_frames_are_a_row_of_their_own(
    folder: Path, data: Path, tmp_path: Path, write_run: WriteRun
) -> None:
    options = LinemodOptions("ape", data, folder / "photographs", gaze=False)
    write_run(tmp_path / "without", options=options)
    written = json.loads((write_run(tmp_path / "with", options=options) / "config.json").read_text())
    written["recipe"]["self_training"] = 0.5
    (tmp_path / "with" / "config.json").write_text(json.dumps(written))
    methods = {candidate.path.name: candidate.method for candidate in candidates(tmp_path)}
    assert methods == {"with": "noncur, self-trained", "without": "noncur"}
    for name, two_stage, expected in (
        ("our", True, "our, two stages"),
        ("hypotheses", True, "hypotheses"),
        ("sleep", True, "sleep"),
        ("sleep", False, "sleep, templates"),
    ):
        written |= {"method": name, "world": written["world"] | {"gaze": True, "two_stage": two_stage}}
        written["recipe"]["self_training"] = 0.0
        (tmp_path / "with" / "config.json").write_text(json.dumps(written))
        assert {one.path.name: one.method for one in candidates(tmp_path)}["with"] == expected
    with pytest.raises(UsageError, match=r"--objects .*: found with and without, both ape; expected one of each"):
        candidates(tmp_path, "--objects", of_any_method=False)


@pytest.mark.parametrize("content", ["{", '{"sleep": {"ape": {"rendered": {}}}}', "[1]"])
def test_other_files_are_no_results(tmp_path: Path, content: str) -> None:
    (tmp_path / "linemod.json").write_text(content)
    with pytest.raises(DataError, match="holds no LineMOD results"):
        load_table(tmp_path / "linemod.json")
