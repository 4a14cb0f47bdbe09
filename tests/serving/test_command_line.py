"""What all command lines share: plain metavars, help with whole lines, --help-all and --version."""

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest
from curio_serve.command_line import parsed, with_lists_joined


@dataclass(frozen=True)
class Command:
    """Does something.

    At length.
    """

    place: Path | None = None
    """Where, which a long sentence says that goes on for more than one line of this source file, and ends only
    there."""
    unit: Literal["m", "mm"] | None = None
    """Of the mesh."""
    count: int | None = 3
    """How many."""


def test_flags_that_may_be_left_out_read_as_what_they_take() -> None:
    assert parsed(Command, [], "curio-x") == Command()
    assert parsed(Command, ["--place", "here", "--unit", "mm", "--count", "4"], "curio-x") == Command(
        Path("here"), "mm", 4
    )
    assert parsed(Command, ["--count", "None"], "curio-x").count is None


@pytest.mark.parametrize("flag", ["-h", "--help", "--help-all"])
def test_help_shows_plain_metavars_and_whole_lines(
    flag: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as done:
        parsed(Command, [flag], "curio-x")
    assert done.value.code == 0
    told = capsys.readouterr().out
    assert "--place PATH" in told
    assert "--unit {m,mm}" in told
    assert "None}" not in told
    assert "for more than one line of this source file, and ends only there." in told
    assert "\nAt length." in told


def test_a_wrong_value_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as done:
        parsed(Command, ["--unit", "furlong"], "curio-x")
    assert done.value.code == 2
    assert "Expected one of ('m', 'mm')" in capsys.readouterr().err


def test_the_version_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as done:
        parsed(Command, ["--version"], "curio-x")
    assert done.value.code == 0
    assert capsys.readouterr().out.startswith("curio-x")


def test_help_ends_quietly_when_its_reader_has_seen_enough() -> None:
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-c", "from curio_serve.batch.detect_cli import main; main()", "--help"]
    with os.fdopen(write, "w") as output:
        done = subprocess.run(command, stdout=output, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, "")


def test_a_flag_of_several_values_may_be_there_twice() -> None:
    given = ["file", "--mesh", "a", "--unit", "mm", "--mesh=b=c", "--mesh", "d", "e", "--count", "-1"]
    joined = ["file", "--unit", "mm", "--count", "-1", "--mesh", "a", "b=c", "d", "e"]
    assert with_lists_joined(given, ("--mesh",)) == joined
    assert with_lists_joined(given, ()) == given
