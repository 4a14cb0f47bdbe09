"""``curio-train capture --calibrate`` as it is typed; from a scene's photographs in test_structure.py."""

from pathlib import Path

import pytest
from curio_train.commands import train as train_command


def call(capsys: pytest.CaptureFixture[str], *flags: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as exit_:
        train_command.train(["capture", "--calibrate", *map(str, flags)])
    captured = capsys.readouterr()
    return int(exit_.value.code or 0), captured.out, captured.err


def test_flags_that_contradict_each_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    views = ["--views-out", tmp_path / "views.json"]
    for flags in (
        ["--every", 0],
        ["--distance-m", 1.0],
        ["--board", 9, 6, *views],
        ["--board", 9, 6, "--distance-m", 1.0],
        ["--board", 9, 6, "--objects", tmp_path],
        ["--objects", tmp_path],
        ["--objects", tmp_path, *views],
        ["--objects", tmp_path, "--camera", tmp_path / "camera.json", "--distance-m", 1.0, *views],
    ):
        status, _, err = call(capsys, "--images", tmp_path, *flags)
        assert status == 2
        assert "error: --" in err


def test_no_photographs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, _, err = call(capsys, "--images", tmp_path / "none", "--board", 9, 6)
    assert status == 1
    assert "there is no such folder" in err
