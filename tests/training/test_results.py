"""The tables of the paper: rows from evaluations, ratios, what is kept, and the command that fills them."""

import fcntl
import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from curio_train.commands.train import parse
from curio_train.errors import DataError, UsageError
from curio_train.learning.runs.configuration import to_json
from curio_train.worlds.options import CaptureOptions
from paper.captures_table import PAPER
from paper.results import collect, load_results, merge, save_results
from paper.results_tables import markdown, plot

ROOT = Path(__file__).parents[2]


def evaluation(method: str, seed: int = 0, **found: Any) -> dict[str, Any]:
    metrics = {"scene_error": 2.0, "novel_view_dssim": 0.1, "position_mm": 300.0, "color_mse": 0.05}
    return {
        "world": "spheres",
        "method": method,
        "reading": "whole",
        "labels": 1.0 if method == "super" else 0.0,
        "seed": seed,
        "images_seen": 640,
        "training_seconds": 9.0,
        "commit": "c0ffee" * 6,
        "machine": "a machine",
        **found,
        "metrics": metrics | found.get("metrics", {}),
    }


def test_a_row_is_the_mean_of_its_seeds_and_its_ratio_to_full_supervision() -> None:
    half = evaluation("super", labels=0.5)
    runs = [evaluation("our", seed, metrics={"scene_error": 3.0 + seed}) for seed in (1, 0)]
    rows = merge({}, collect([*runs, evaluation("super"), half]))["spheres"]
    assert list(rows) == ["super_1.0", "our"]  # 0.5 is no row of the table
    our = rows["our"]
    assert (our["seeds"], our["para"], our["para_ratio"], our["img_ratio"]) == ([0, 1], 3.5, 1.75, 1.0)
    assert our["by_seed"]["para"] == [3.0, 4.0]
    assert our["per_parameter"] == {"position_m": pytest.approx(0.3), "color_mse": 0.05}
    assert our["per_parameter_ratio"] == {"position_m": 1.0, "color_mse": 1.0}
    assert (our["label_free"], our["synthetic_labels"]) == (True, False)
    assert (rows["super_1.0"]["label_free"], rows["super_1.0"]["para_ratio"]) == (False, 1.0)


def test_shares_of_labels_are_rows_of_their_own() -> None:
    rows = merge({}, collect([evaluation("super", labels=share) for share in (1.0, 0.1, 0.05)]))["spheres"]
    assert list(rows) == ["super_1.0", "super_0.1", "super_0.05"]


def test_images_read_by_cells_are_a_row_of_their_own() -> None:
    rows = merge({}, collect([evaluation("sleep"), evaluation("sleep", reading="cells"), evaluation("super")]))
    rows = merge(rows, collect([evaluation("super", reading="cells")]))
    assert list(rows["spheres"]) == ["super_1.0", "sleep", "super_1.0_cells", "sleep_cells"]


def test_without_the_reference_there_is_no_ratio_yet() -> None:
    rows = merge({}, collect([evaluation("sleep")]))["spheres"]
    assert (rows["sleep"]["para"], rows["sleep"]["para_ratio"]) == (2.0, None)
    assert rows["sleep"]["synthetic_labels"]
    assert rows["sleep"]["per_parameter_ratio"] == {"position_m": None, "color_mse": None}


def test_rows_of_another_budget_are_of_another_table() -> None:
    old = merge({}, collect([evaluation("super"), evaluation("our")]))
    same = merge(old, collect([evaluation("noncur", metrics={"scene_error": 4.0})]))["spheres"]
    assert list(same) == ["super_1.0", "noncur", "our"]
    assert same["noncur"]["para_ratio"] == 2.0
    other = merge(old, collect([evaluation("noncur", images_seen=1280)]))["spheres"]
    assert list(other) == ["noncur"]
    with pytest.raises(DataError, match=r"our saw \[640, 1280\] images; a row needs one budget"):
        collect([evaluation("our"), evaluation("our", 1, images_seen=1280)])


def test_a_row_of_fewer_seeds_does_not_replace_one_of_more() -> None:
    old = merge({}, collect([evaluation("our", seed) for seed in range(3)]))
    assert merge(old, collect([evaluation("our")]))["spheres"]["our"]["seeds"] == [0, 1, 2]
    new = collect([evaluation("our", seed, metrics={"scene_error": 9.0}) for seed in range(3)])
    assert merge(old, new)["spheres"]["our"]["para"] == 9.0


def test_other_seeds_are_joined_to_a_row() -> None:
    rows = merge({}, collect([evaluation("our", metrics={"position_mm": 600.0})]))
    for seed in (2, 1):  # one after another, each merged into what was stored
        rows = merge(rows, collect([evaluation("our", seed, training_seconds=9.0 + seed)]))
    our = rows["spheres"]["our"]
    assert (our["seeds"], our["by_seed"]["seconds"]) == ([0, 1, 2], [9.0, 10.0, 11.0])
    assert our["per_parameter"]["position_m"] == pytest.approx(0.4)
    assert our["by_seed"]["position_m"] == pytest.approx([0.6, 0.3, 0.3])
    assert our["seconds"] == 10.0


def test_rows_of_seeds_that_cannot_be_taken_apart_stay_unless_others_are_more() -> None:
    old = merge({}, collect([evaluation("our", seed, metrics={"scene_error": 9.0}) for seed in range(2)]))
    old["spheres"]["our"]["by_seed"] = {"img": [0.1, 0.1], "para": [9.0, 9.0]}
    assert merge(old, collect([evaluation("our", 2)]))["spheres"]["our"]["seeds"] == [0, 1]
    new = merge(old, collect([evaluation("our", seed) for seed in (1, 2, 3)]))
    assert new["spheres"]["our"]["seeds"] == [1, 2, 3]


def test_tables_show_ours_beside_the_papers(tmp_path: Path) -> None:
    runs = [evaluation("super"), evaluation("our", metrics={"scene_error": 3.0}), evaluation("wake_sleep")]
    results = merge({}, collect(runs))
    text = markdown(results, "make results")
    para = text.partition("## Table 2: Para")[2].partition("##")[0]
    assert "| world | `our` | `wake_sleep` |" in para
    assert "| spheres | 1.5 (1.87) | 1 |" in para
    assert "### Position" in text
    assert "### Rotation" not in text
    cells = [evaluation("super", reading="cells", metrics={"scene_error": 0.5}), evaluation("our", reading="cells")]
    text = markdown(merge(results, collect(cells)), "make results")
    own = text.partition("## Para, against supervision of the same network")[2].partition("##")[0]
    assert "| spheres | – (8.97) | 1.5 (1.87) | – | – | 4 | – |" in own
    plot(results, tmp_path / "worlds.png")
    assert (tmp_path / "worlds.png").stat().st_size > 10_000


@pytest.mark.parametrize("content", ["", "[1]", '{"spheres": {"our": {"img": 1}}}', '{"spheres": 3}'])
def test_a_damaged_file_of_results_is_refused(tmp_path: Path, content: str) -> None:
    file = tmp_path / "worlds.json"
    assert load_results(file) == {}
    file.write_text(content)
    with pytest.raises(DataError, match="holds no results of worlds"):
        load_results(file)


def test_results_are_kept_whole(tmp_path: Path) -> None:
    results = merge({}, collect([evaluation("super")]))
    save_results(tmp_path / "docs" / "worlds.json", results)
    assert load_results(tmp_path / "docs" / "worlds.json") == results


def command(folder: Path, *flags: str) -> subprocess.CompletedProcess[str]:
    places = ["--runs", str(folder / "runs"), "--results", str(folder / "worlds.json")]
    line = [sys.executable, str(ROOT / "benchmarks" / "results.py"), *places, *flags]
    return subprocess.run(line, capture_output=True, text=True, timeout=600, check=False)


def test_the_command_fills_the_table_and_goes_on_where_it_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    module = benchmark_module("results", monkeypatch)
    places = {"runs": tmp_path / "runs", "results": tmp_path / "worlds.json"}
    settings = module.Settings(only=("circles",), methods=("super_1.0", "noncur"), images=64, seeds=(0,), **places)
    busy = tmp_path / "runs" / "circles-laptop-64" / "noncur-0.log"
    busy.parent.mkdir(parents=True)
    with busy.open("wb") as log:
        fcntl.flock(log, fcntl.LOCK_EX)
        assert module.main(settings) == 1
    assert "circles noncur seed 0, 64 images: another process is at work on it" in capsys.readouterr().err
    assert list(json.loads((tmp_path / "worlds.json").read_text())["circles"]) == ["super_1.0"]
    flags = ["--only", "circles", "--methods", "super_1.0", "noncur", "--images", "64", "--seeds", "0"]
    second = command(tmp_path, *flags)
    assert second.returncode == 0, second.stderr
    assert "1 of 2 runs are done" in second.stderr
    rows = json.loads((tmp_path / "worlds.json").read_text())["circles"]
    assert list(rows) == ["super_1.0", "noncur"]
    assert rows["noncur"]["images_seen"] == 64
    assert rows["noncur"]["para_ratio"] == pytest.approx(rows["noncur"]["para"] / rows["super_1.0"]["para"])
    assert "| circles |" in (tmp_path / "worlds.md").read_text()
    assert (busy.parent / "noncur-0" / "report.html").exists()


def test_what_begins_as_another_run_is_a_row_of_its_own() -> None:
    found = evaluation("our", reading="cells", method_before="hypotheses")
    assert list(collect([found, evaluation("our", reading="cells", method_before="our")])["spheres"]) == [
        "our_found_cells",
        "our_cells",
    ]


def test_what_begins_as_another_run_sees_as_many_images_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = benchmark_module("results", monkeypatch)
    methods = ("hypotheses_cells", "our_found_cells")
    settings = module.Settings(only=("chairs",), methods=methods, seeds=(0,), images=600, runs=tmp_path)
    before, run = module.plan(settings)
    first, _, second, _ = run.commands()
    assert first[1:4] == second[1:4] == ["chairs", "--images", "600"]
    assert "hypotheses" in first
    assert second[second.index("--init") + 1] == first[first.index("--out") + 1] == str(before.folder)
    old = merge({}, collect([evaluation("super"), evaluation("our", reading="cells")]))
    found = evaluation("our", reading="cells", method_before="hypotheses", images_seen=1280)
    assert list(merge(old, collect([found]))["spheres"]) == ["super_1.0", "our_cells", "our_found_cells"]


def test_an_unknown_row_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = benchmark_module("results", monkeypatch)
    with pytest.raises(UsageError, match="--methods ours: there is no such row") as caught:
        module.main(module.Settings(methods=("ours",), runs=tmp_path, results=tmp_path / "worlds.json"))
    assert caught.value.exit_status == 2


def benchmark_module(name: str, monkeypatch: pytest.MonkeyPatch) -> Any:
    spec = importlib.util.spec_from_file_location(name, ROOT / "benchmarks" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    benchmark = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, benchmark)  # where its dataclasses look their types up
    spec.loader.exec_module(benchmark)
    return benchmark


def test_the_sweep_keeps_what_other_worlds_and_earlier_calls_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep = benchmark_module("curiosity", monkeypatch)
    scored = {"images_seen": 640, "training_seconds": 6.0, "machine": "a machine", "commit": "abc"}
    told = {"images": 640, "runs": tmp_path, "results": tmp_path / "curiosity.json"}
    for world, only, para in (("circles", "our", 1.5), ("spheres", "noncur", 2.5), ("circles", "noncur", 3.5)):
        settings = sweep.Settings(world=world, only=(only,), reading="cells" if world == "spheres" else "whole", **told)
        (run,) = sweep.plan(settings)
        run.folder.mkdir(parents=True)
        found = scored | {"metrics": {"scene_error": para, "novel_view_dssim": 0.1}}
        (run.folder / "evaluation.json").write_text(json.dumps(found))
        sweep.write(settings, [run])
    results = json.loads((tmp_path / "curiosity.json").read_text())
    assert {world: {name: row["para"] for name, row in rows.items()} for world, rows in results.items()} == {
        "circles": {"our": 1.5, "noncur": 3.5},
        "spheres, read by the dense decoder": {"noncur": 2.5},
    }
    assert "## Spheres, read by the dense decoder" in (tmp_path / "curiosity.md").read_text()


def test_the_sweep_varies_one_thing_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sweep = benchmark_module("curiosity", monkeypatch)
    runs = sweep.plan(sweep.Settings(world="circles", reading="whole", images=640, runs=tmp_path))
    assert len({run.folder for run in runs}) == len(runs) == len(sweep.VARIANTS)
    configs = {run.name: to_json(parse(["circles", "--images", str(run.images), *run.flags]).config) for run in runs}
    plain = flat(configs["noncur"])
    changes = {
        name: {key for key, value in flat(config).items() if value != plain[key]}
        for name, config in configs.items()
        if config["method"] == "noncur" and name != "noncur"
    }
    assert changes.pop("noncur, small batches") == {"recipe.batch_size", "recipe.micro_batch_size"}
    assert all(len(changed) == 1 for changed in changes.values()), changes
    ours, instance = flat(configs["our"]), flat(configs["our, instance norm"])
    assert {key for key in ours if ours[key] != instance[key]} == {"network.critic_normalisation"}
    unpenalised = flat(configs["our, no gradient penalty"])
    assert {key for key in ours if ours[key] != unpenalised[key]} == {"recipe.gradient_penalty"}


def flat(config: dict[str, Any]) -> dict[str, Any]:
    nested = {f"{key}.{name}": value for key in ("recipe", "network") for name, value in config[key].items()}
    return {key: value for key, value in config.items() if key not in ("recipe", "network")} | nested


def test_the_benchmark_asks_for_worlds_that_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every method of the paper's table in every scene, by flags that a command line takes."""
    benchmark = benchmark_module("captures", monkeypatch)
    runs = benchmark.plan(benchmark.Settings())
    assert {(scene, method) for scene, rows in PAPER.items() for method in rows} <= runs.keys()
    for (scene, method), run in runs.items():
        command = parse([run.world, "--images", str(run.images), *run.flags])
        world = command.config.world
        assert isinstance(world, CaptureOptions)
        assert (world.lying, len(world.count_ranges)) == (scene == "bunny", len(world.mesh))
        assert command.config.method + "_cells" * (command.config.network.reading == "cells") == method
