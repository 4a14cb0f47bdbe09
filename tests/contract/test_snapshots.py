"""Help and error texts, word for word: a change of what users read is a change of a file here.

After a change that is meant, write them anew and read the difference before you commit it::

    CURIO_RENEW_SNAPSHOTS=1 pytest tests/contract/test_snapshots.py && git diff tests/contract/snapshots
"""

import importlib
import os
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import pytest

SNAPSHOTS = Path(__file__).parent / "snapshots"
HELP = {
    "train": "curio-train",
    "train-circles": "curio-train circles",
    "train-linemod": "curio-train linemod",
    "train-capture": "curio-train capture",
    "train-linemod-all": "curio-train linemod --help-all",
    "train-capture-all": "curio-train capture --help-all",
    "train-capture-calibrate": "curio-train capture --calibrate",
    "train-capture-assistant": "curio-train capture --assistant",
    "eval": "curio-eval",
    "export": "curio-export",
    "doctor": "curio-doctor",
    "view": "curio-view",
    "render": "curio-render",
    "serve": "curio-serve",
    "detect": "curio-detect",
}
ERRORS = {
    "train-no-world": "curio-train",
    "train-unknown-world": "curio-train atlantis",
    "train-unknown-method": "curio-train circles --method magic",
    "train-labels-of-a-method-without": "curio-train circles --labels 0.1",
    "train-negative-budget": "curio-train circles --minutes -1",
    "train-micro-batches": "curio-train circles --batch-size 100",
    "train-no-run-folder": "curio-train circles --resume nowhere",
    "train-no-class": "curio-train linemod",
    "train-mistyped-world": "curio-train linmod --class ape",
    "train-mistyped-class": "curio-train linemod --class aple --data lmo",
    "train-mistyped-flag": "curio-train linemod --class ape --minuts 3",
    "train-pseudo-labels-without-photos": "curio-train linemod --class ape --data lmo --self-training 0.5",
    "train-poses-without-photos": "curio-train linemod --class ape --data lmo --views views.json",
    "train-photos-of-the-paper-network": "curio-train linemod --class ape --data lmo --photos . --one-stage",
    "train-capture-no-mesh": "curio-train capture --mesh gone.stl --camera camera.json --photos .",
    "eval-nothing-there": "curio-eval nowhere",
    "eval-no-model": "curio-eval text.onnx",
    "export-no-run": "curio-export empty",
    "doctor-no-mesh-named": "curio-doctor --mesh",
    "render-unknown-world": "curio-render atlantis --out renderings",
    "serve-no-folder": "curio-serve nowhere",
    "serve-port": "curio-serve empty --port 70000",
    "detect-no-images": "curio-detect text.onnx",
    "detect-no-model": "curio-detect nowhere photo.png",
    "detect-min-confidence": "curio-detect text.onnx photo.png --min-confidence 1.5",
}


@pytest.fixture
def typed(
    scripts: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[[str], str]:
    """``typed(line)``: what a command prints on a terminal of 100 columns, and its exit status if that is not 0."""
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.onnx").write_text("not a graph")
    (tmp_path / "photo.png").write_text("not a picture")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("HOME", str(tmp_path))

    def run(line: str) -> str:
        name, *words = line.split()
        module, _, function = scripts[name].partition(":")
        monkeypatch.setattr(sys, "argv", [name, *words])
        with pytest.raises(SystemExit) as exit_:
            getattr(importlib.import_module(module), function)()
        assert exit_.value.code in (None, 0, 1, 2), "stopped by a signal: nothing to compare or to renew"
        told = capsys.readouterr()
        printed = "\n".join(text.rstrip() for text in (told.out + told.err).splitlines())
        status = f"\nexit status {exit_.value.code}" if exit_.value.code else ""
        return f"$ {line}\n{printed.replace(str(tmp_path), 'HERE')}{status}\n"

    return run


def compare(file: Path, found: str) -> None:
    if os.environ.get("CURIO_RENEW_SNAPSHOTS"):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(found, encoding="utf-8")
    assert found == file.read_text(encoding="utf-8"), f"see the head of {Path(__file__).name}"


@pytest.mark.parametrize("name", HELP)
def test_help(name: str, typed: Callable[[str], str]) -> None:
    compare(SNAPSHOTS / "help" / f"{name}.txt", typed(f"{HELP[name]} --help"))


@pytest.mark.parametrize("command", sorted({line.split()[0] for line in HELP.values()}))
def test_version(command: str, typed: Callable[[str], str]) -> None:
    assert typed(f"{command} --version") == f"$ {command} --version\n{command} {version('curio-pose')}\n"


@pytest.mark.parametrize("name", ERRORS)
def test_error_texts(name: str, typed: Callable[[str], str]) -> None:
    compare(SNAPSHOTS / "errors" / f"{name}.txt", typed(ERRORS[name]))


def test_every_command_and_every_file_has_its_snapshot(scripts: dict[str, str]) -> None:
    assert {line.split()[0] for line in HELP.values()} == scripts.keys()
    for kind, cases in (("help", HELP), ("errors", ERRORS)):
        assert {file.stem for file in (SNAPSHOTS / kind).iterdir()} == cases.keys()
