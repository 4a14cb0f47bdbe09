"""``curio-train capture`` as it is typed: --calibrate, of a scene's photographs in test_structure.py, and --project."""

from pathlib import Path

import pytest
from curio_train.commands import train as train_command
from curio_train.commands.command_line.project_file import with_project


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


def test_what_would_end_in_nothing_is_refused_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """There are no photographs, which is what is found out first where there is work."""
    views, board = ["--views-out", tmp_path / "views.json"], ["--board", 9, 6]
    for flags, told in (
        ([*board, "--camera-out", "."], "--camera-out .: this is a folder"),
        (["--views-out", tmp_path], f"--views-out {tmp_path}: this is a folder"),
        ([*board, "--rig-out", tmp_path / "none" / "rig.json"], f"there is no folder {tmp_path / 'none'}"),
        ([*views, "--distance-m", 0], "--distance-m 0: expected a distance in metres"),
        ([*views, "--distance-m", -0.5], "--distance-m -0.5: expected"),
        ([*views, "--distance-m", "nan"], "--distance-m nan: expected"),
        (["--camera", "camera.json"], "--camera camera.json has no effect without --views-out"),
        (["--marker-mm", 22], "--marker-mm 22.0 has no effect without --board"),
        (["--square-mm", 25], "--square-mm 25.0 has no effect without --board"),
        ([*views, "--data", "lmo"], "--data lmo has no effect without --objects"),
        ([*board, "--rig-out", tmp_path / "rig.json", "--camera-out", "c.json"], "not written with --rig-out"),
        ([*views, "--camera", "camera.json", "--camera-out", "c.json"], "not written with --camera"),
    ):
        status, _, err = call(capsys, "--images", tmp_path / "none", *flags)
        assert (status, told in err) == (2, True), err
    assert not [*tmp_path.iterdir()]


def test_no_photographs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, _, err = call(capsys, "--images", tmp_path / "none", "--board", 9, 6)
    assert status == 1
    assert "there is no such folder" in err


def test_a_project_file_may_follow_an_equals_sign(tmp_path: Path) -> None:
    (tmp_path / "part.toml").write_text("minutes = 3\n")
    assert with_project(["capture", f"--project={tmp_path / 'part.toml'}"], ()) == ["capture", "--minutes=3"]
