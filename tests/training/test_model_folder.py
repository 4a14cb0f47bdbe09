"""Versions in a model's folder: their numbers, and what is left where one cannot be written."""

from pathlib import Path

import pytest
from curio_serve.models.model_folder import is_model_name
from curio_train.errors import ExportError
from curio_train.export.folder import ModelFolder


def test_a_number_that_is_taken_is_passed_over_and_a_lost_config_is_written_again(tmp_path: Path) -> None:
    folder, files_of = ModelFolder(tmp_path / "one"), {"model.onnx": b"graph"}
    folder.add(folder.next_version(), files_of, "config", "first")
    (tmp_path / "one" / "2").mkdir()
    (tmp_path / "one" / "2" / "notes.txt").write_text("dear")
    (tmp_path / "one" / "config.pbtxt").unlink()
    assert folder.add(folder.next_version(), files_of, "config", "third").name == "3"
    assert (tmp_path / "one" / "config.pbtxt").read_text() == "config"
    listed = [line.split("  ")[1] for line in (tmp_path / "one" / "SHA256SUMS").read_text().splitlines()]
    assert listed == ["1/model.onnx", "3/model.onnx"]
    assert (tmp_path / "one" / "2" / "notes.txt").read_text() == "dear"


def test_of_two_exports_at_once_the_first_stays_whole(tmp_path: Path) -> None:
    folder = ModelFolder(tmp_path / "one")
    folder.add(folder.next_version(), {"model.onnx": b"graph"}, "config", "first")
    number = folder.next_version()  # both find it
    folder.add(number, {"model.onnx": b"faster"}, "config", "second")
    before = (tmp_path / "one" / "SHA256SUMS").read_text()
    with pytest.raises(ExportError, match="another export has just written it"):
        folder.add(number, {"model.onnx": b"slower"}, "config", "third")
    assert (tmp_path / "one" / "SHA256SUMS").read_text() == before
    assert (tmp_path / "one" / "2" / "model.onnx").read_bytes() == b"faster"


def test_a_version_that_cannot_be_put_in_place_leaves_the_sums(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = ModelFolder(tmp_path / "one")
    folder.add(1, {"model.onnx": b"graph"}, "config", "first")
    before = (tmp_path / "one" / "SHA256SUMS").read_text()

    def full(self: Path, target: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "rename", full)
    with pytest.raises(ExportError, match="No space left on device"):
        folder.add(2, {"model.onnx": b"faster"}, "config", "second")
    assert (tmp_path / "one" / "SHA256SUMS").read_text() == before


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("ape", "ape"),
        ("Träger links", "Trager-links"),
        (".hidden", "hidden"),
        ("部品", "part"),
        ("a" * 70, "a" * 64),
        ("bracket_v1.2", "bracket_v1.2"),
    ],
)
def test_names_of_files_become_names_of_models(text: str, name: str) -> None:
    assert ModelFolder.fitting_name(text) == name
    assert is_model_name(name)
