"""What a run of one's own part leaves beside itself where a second process makes the report."""

import shutil
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from curio_train.commands.finish import end
from curio_train.export import write_model
from curio_train.export.ahead import TracingAhead
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.learning.runs.interruption import Interrupted
from curio_train.worlds import build
from curio_train.worlds.options import CaptureOptions, CirclesOptions, SpheresOptions


@pytest.mark.parametrize("is_writable", [True, False])
def test_the_report_is_made_beside_the_model(circles_run: Path, cache: Path, tmp_path: Path, is_writable: bool) -> None:
    run, warnings, said = tmp_path / "run", list[str](), list[str]()
    shutil.copytree(circles_run, run)
    if not is_writable:
        (run / "report.html").mkdir()
    made = RunFolder.open(run).config
    part = CaptureOptions(mesh=(tmp_path / "part.stl",), camera=tmp_path / "camera.json", photos=tmp_path)
    told = end(run, replace(made, world=part), cache, warnings.append, said.append, TracingAhead(made))
    assert f"curio-serve {run / 'models'}" in told
    assert said == [f"{run}: writing report and model"]
    assert (run / "models" / "circles" / "1" / "model.onnx").is_file()
    assert (run / "report.html").is_file() == is_writable
    assert [str(run / "report.html") in warning for warning in warnings] == [True] * (not is_writable)


@pytest.mark.usefixtures("small_image_sets")
def test_what_curio_view_cannot_show_is_not_told_to_be_viewed(write_run: Callable[..., Path], tmp_path: Path) -> None:
    for options, is_shown in ((CirclesOptions(), False), (SpheresOptions(), True)):
        assert (build(options).camera.matrix is not None) == is_shown
        run, said = write_run(tmp_path / type(options).__name__, options), list[str]()
        told = end(run, RunFolder.open(run).config, tmp_path / "cache", pytest.fail, said.append)
        assert said == [f"{run}: writing the report"]
        assert f"to see what it learned: {run / 'report.html'}" in told
        assert (f"curio-view {run}" in told) == is_shown


def test_a_stop_while_the_model_is_made_says_how_to_go_on(
    circles_run: Path, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, said = tmp_path / "my run", list[str]()
    shutil.copytree(circles_run, run)
    made = RunFolder.open(run).config
    part = CaptureOptions(mesh=(tmp_path / "part.stl",), camera=tmp_path / "camera.json", photos=tmp_path)

    def interrupted(*_: object, **__: object) -> None:
        raise Interrupted(signal.SIGTERM)

    monkeypatch.setattr(write_model, "export", interrupted)
    with pytest.raises(Interrupted):
        end(run, replace(made, world=part), cache, pytest.fail, said.append)
    assert said[-1] == f"{run} is trained and whole; to make its model: curio-export '{run}' --out '{run}/models'"
