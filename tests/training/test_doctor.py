"""What curio-doctor finds good, and what it finds wrong."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from curio_train import cli, doctor


def run(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, str]]:
    """Exit status, and each subject with its state and text."""
    with pytest.raises(SystemExit) as exit_:
        cli.doctor(arguments)
    lines = capsys.readouterr().out.splitlines()
    findings = {}
    for line in lines:
        state, rest = line.split(maxsplit=1)
        subject, text = rest.split(": ", 1)
        findings[subject] = f"{state} {text}"
    return int(exit_.value.code or 0), findings


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    path = tmp_path / "camera.json"
    matrix = [[100.0, 0, 49.5], [0, 100.0, 39.5], [0, 0, 1]]
    path.write_text(json.dumps({"camera_matrix": matrix, "width": 100, "height": 80}))
    return path


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for number in range(3):
        cv2.imwrite(str(folder / f"{number}.png"), np.full((80, 100, 3), 90, np.uint8))
    return folder


def test_a_fit_machine_and_good_files(
    tmp_path: Path, camera: Path, photos: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mesh = trimesh.creation.box((30, 40, 120))
    mesh.visual.vertex_colors = np.full((8, 4), 200, np.uint8)
    mesh.export(tmp_path / "box.ply")
    flags = ["--mesh", str(tmp_path / "box.ply"), "--mesh-unit", "mm", "--camera", str(camera), "--photos", str(photos)]
    status, findings = run([*flags, "--cache", str(tmp_path / "not" / "yet")], capsys)
    assert status == 0
    assert findings["rendering"].startswith("good")
    assert findings["libLLVM"].startswith("good")
    assert "12 faces, 30 x 40 x 120 mm, diameter 130 mm" in findings["mesh"]
    assert "100x80 pixels, sees 53 by 44 degrees" in findings["camera"]
    assert findings["photographs"].endswith("3 of 100x80")
    assert f"disk at {tmp_path}" in findings


def test_a_machine_without_a_usable_llvm(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    old = tmp_path / "libLLVM-15.so.1"
    old.touch()
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(old))
    findings = {finding.subject: finding for finding in doctor.examine_machine(tmp_path)}
    assert findings["libLLVM"].state == "bad"
    assert "apt-get install libllvm19" in findings["libLLVM"].text
    assert "rendering" not in findings, "a process would have been aborted"


def test_a_library_that_is_none_is_found_by_rendering(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """By its name it is new enough; only trying shows what it is."""
    fake = tmp_path / "libLLVM.so.19.1"
    fake.write_bytes(b"not a library")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(fake))
    findings = {finding.subject: finding for finding in doctor.examine_machine(tmp_path)}
    assert findings["libLLVM"].state == "good"
    assert findings["rendering"].state == "bad"
    assert "DRJIT_LIBLLVM_PATH" in findings["rendering"].text


def test_wrong_files_are_named(tmp_path: Path, photos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trimesh.creation.box((30, 40, 120)).export(tmp_path / "box.stl")
    (tmp_path / "camera.json").write_text('{"camera_matrix": [[0, 0, 50], [0, 0, 40], [0, 0, 1]]}')
    (photos / "broken.png").write_bytes(b"\x89PNG")
    flags = ["--mesh", "box.stl", "--camera", "camera.json", "--photos", "photos", "--cache", "."]
    status, findings = run([str(tmp_path / f) if (tmp_path / f).exists() else f for f in flags], capsys)
    assert status == 1
    assert findings["mesh"].startswith("bad")
    assert "--mesh-unit" in findings["mesh"]
    assert findings["camera"].startswith("bad")
    assert findings["photographs"].startswith("bad 1 of 4 cannot be read, the first: ")
    assert "broken.png" in findings["photographs"]


def test_photographs_of_another_size_are_not_of_this_camera(camera: Path, photos: Path) -> None:
    cv2.imwrite(str(photos / "9.png"), np.zeros((40, 50, 3), np.uint8))
    intrinsics, _ = doctor.examine_camera(camera)
    finding = doctor.examine_photos(photos, intrinsics)
    assert finding.state == "bad"
    assert "3 of 100x80, 1 of 50x40" in finding.text
    assert doctor.examine_photos(photos, None).state == "good"


def test_a_mesh_without_colours_is_a_warning(tmp_path: Path) -> None:
    trimesh.creation.box((30, 40, 120)).export(tmp_path / "box.stl")
    finding = doctor.examine_mesh(tmp_path / "box.stl", "mm")
    assert finding.state == "warning"
    assert "no colours" in finding.text
