"""What curio-doctor says of this machine, and how it says it; planted faults are in test_doctor_faults.py."""

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
import trimesh
from curio_serve.models.runtime import available_providers, short_name
from curio_train.commands import doctor as doctor_command
from curio_train.config import Recipe, WorldOptions, preset_recipe
from curio_train.doctor import abilities, trials
from curio_train.doctor.examine import Subjects, examine_files
from curio_train.doctor.machine import examine_machine
from curio_train.meshes.shapes import sphere


def run(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, str]]:
    """Exit status, and each subject with its state and text."""
    with pytest.raises(SystemExit) as exit_:
        doctor_command.doctor(arguments)
    lines = capsys.readouterr().out.splitlines()
    findings = {}
    for line in lines:
        state, rest = line.split(maxsplit=1)
        subject, text = rest.split(": ", 1)
        findings[subject] = f"{state} {text}"
    return int(exit_.value.code or 0), findings


def test_good_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mesh = trimesh.creation.box((30, 40, 120))
    mesh.visual.vertex_colors = np.full((8, 4), 200, np.uint8)
    mesh.export(tmp_path / "box.ply")
    camera = tmp_path / "camera.json"
    matrix = [[100.0, 0, 49.5], [0, 100.0, 39.5], [0, 0, 1]]
    camera.write_text(json.dumps({"camera_matrix": matrix, "width": 100, "height": 80}))
    flags = ["--mesh", str(tmp_path / "box.ply"), "--mesh-unit", "mm", "--camera", str(camera)]
    flags += ["--symmetries", str(tmp_path / "models_info.json")]
    status, findings = run([*flags, "--cache", str(tmp_path / "not" / "yet")], capsys)
    assert status == 0
    assert "12 faces, 30 x 40 x 120 mm, diameter 130 mm" in findings["mesh"]
    assert "3 discrete" in findings["mesh symmetries"]
    assert "100x80 pixels, sees 53 by 44 degrees" in findings["camera"]
    assert all(subject.startswith(("mesh", "camera")) for subject in findings), "nothing about a machine that is fit"
    entry = json.loads((tmp_path / "models_info.json").read_text())["1"]
    assert entry["diameter"] == pytest.approx(130)
    assert (entry["min_x"], entry["size_z"]) == pytest.approx((-15, 120))
    assert len(entry["symmetries_discrete"]) == 3


@pytest.mark.usefixtures("one_thread")  # which the timing would change
def test_every_mesh_is_looked_at(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trimesh.creation.box((80, 40, 20)).export(tmp_path / "good.stl")
    trimesh.creation.box((30, 30, 60)).export(tmp_path / "other.stl")
    good, other, missing = (str(tmp_path / name) for name in ("good.stl", "other.stl", "missing.stl"))
    for meshes, status in (
        (["--mesh", good, other], 0),
        (["--mesh", missing, "--mesh", good], 1),
        (["--mesh", good, missing], 1),
    ):
        with pytest.raises(SystemExit) as caught:
            doctor_command.doctor([*meshes, "--mesh-unit", "mm", "--cache", str(tmp_path)])
        assert caught.value.code == status
        told = capsys.readouterr().out
        assert all(name in told for name in meshes if name != "--mesh")
    with pytest.raises(SystemExit):
        doctor_command.doctor(["--mesh", good, other, "--mesh-unit", "mm", "--symmetries", str(tmp_path / "new.json")])
    assert "is for one --mesh, found 2" in capsys.readouterr().err


def test_a_fit_machine(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Training is timed in this process: in small steps, from few images and of a coarse sphere."""
    of_its_own = abilities._trial

    def trial(call: str) -> tuple[float | None, str]:
        if call == "render_a_box()":
            return of_its_own(call)
        name, world = call.removesuffix("')").split("('")
        speed = getattr(trials, name)(world)
        assert speed > 0
        return speed, ""

    def small(preset: Literal["laptop"], kind: type[WorldOptions]) -> Recipe:
        return replace(preset_recipe(preset, kind), batch_size=4, micro_batch_size=4)

    monkeypatch.setattr(abilities, "_trial", trial)
    monkeypatch.setattr(trials, "preset_recipe", small)
    monkeypatch.setattr(trials, "_NUM_IMAGES", 8)
    monkeypatch.setattr(trials, "sphere", lambda radius, subdivisions: sphere(radius, 2))
    status, findings = run(["--cache", str(tmp_path / "not" / "yet")], capsys)
    assert status == 0
    assert findings["rendering"].startswith("good")
    assert findings["libLLVM"].startswith("good")
    assert f"disk at {tmp_path}" in findings
    for subject, text in (
        ("training time of capture and linemod --two-stage", "--method sleep on the CPU: 240,000 images"),
        ("training time of circles, the quickest of the generated worlds", "--method our on the CPU: 48,000 images"),
    ):
        assert text in findings[subject]


def test_files_are_answered_without_torch(tmp_path: Path) -> None:
    """Torch takes longer to be imported than the files to be read."""
    call = f"doctor(['--camera', {str(tmp_path / 'camera.json')!r}])"
    code = f"import atexit, sys\nfrom curio_train.commands.doctor import doctor\n{_AT_EXIT}\n{call}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.endswith("heavy: []\n"), done


_AT_EXIT = "atexit.register(lambda: print('heavy:', [one for one in ('torch', 'mitsuba') if one in sys.modules]))"


def test_beside_files_a_fault_of_the_machine_is_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "libLLVM-15.so.1").touch()
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "libLLVM-15.so.1"))
    status, findings = run(["--camera", str(tmp_path / "camera.json"), "--cache", str(tmp_path)], capsys)
    assert status == 1
    assert set(findings) == {"libLLVM", "camera"}


def test_a_finding_says_how_sure_it_is_and_what_to_do(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text('{"width": 640, "height": 480, "fx": 600, "fy": 600, "cx": 240, "cy": 320}')
    good, finding = examine_files(Subjects(camera=path))
    assert "(certain)" not in str(good)
    assert "(likely). Swap cx and cy" in str(finding)


@pytest.mark.parametrize("flag", ["--symmetries out.json", "--body pin", "--mesh-unit mm"])
def test_what_is_about_a_mesh_needs_one(flag: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        doctor_command.doctor([*flag.split(), "--cache", str(tmp_path)])
    assert exit_.value.code == 2
    assert f"{flag}: found no --mesh" in capsys.readouterr().err


def test_symmetries_replace_no_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trimesh.creation.box((30, 40, 120)).export(tmp_path / "box.ply")
    out = tmp_path / "models_info.json"
    out.write_text("of other objects")
    flags = ["--mesh", str(tmp_path / "box.ply"), "--mesh-unit", "mm", "--cache", str(tmp_path), "--symmetries"]
    with pytest.raises(SystemExit) as exit_:
        doctor_command.doctor([*flags, str(out)])
    assert exit_.value.code == 2
    assert "name a new one" in capsys.readouterr().err
    assert out.read_text() == "of other objects"
    with pytest.raises(SystemExit) as exit_:
        doctor_command.doctor([*flags, str(tmp_path / "none" / "models_info.json")])
    assert exit_.value.code == 1
    assert "cannot be written (No such file or directory); name another file: --symmetries" in capsys.readouterr().err


def test_a_machine_without_a_usable_llvm(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old = tmp_path / "libLLVM-15.so.1"
    old.touch()
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(old))
    status, findings = run(["--cache", str(tmp_path)], capsys)
    assert status == 1
    assert findings["libLLVM"].startswith("bad")
    assert "apt-get install libllvm19" in findings["libLLVM"]
    assert "rendering" not in findings, "a process would have been aborted"


def test_a_cache_that_cannot_be_reached(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The folder above it stands for it, as for one that is still to be made."""
    cache = tmp_path / ("a" * 300)
    status, findings = run(["--camera", str(tmp_path / "camera.json"), "--cache", str(cache)], capsys)
    assert status == 1
    assert set(findings) == {"camera"}


def test_a_library_that_is_none_is_found_by_rendering(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """By its name it is new enough; only trying shows what it is."""
    fake = tmp_path / "libLLVM.so.19.1"
    fake.write_bytes(b"not a library")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(fake))
    findings = {finding.subject: finding for finding in examine_machine(tmp_path)}
    assert findings["libLLVM"].state == "good"
    assert findings["rendering"].state == "bad"
    assert "DRJIT_LIBLLVM_PATH" in findings["rendering"].remedy


def test_a_model_is_tried_on_every_provider(tmp_path: Path) -> None:
    shutil.copytree(Path(__file__).parents[2] / "models" / "ape", tmp_path / "ape")
    (version,) = (tmp_path / "ape").glob("[0-9]*")
    (model, *tried) = examine_files(Subjects(model=tmp_path / "ape"))
    assert model.subject == "model"
    assert [finding.subject for finding in tried] == [f"model on {short_name(name)}" for name in available_providers()]
    assert {finding.state for finding in tried} == {"good"}
    assert re.search(r" ms for the golden image \(CPUExecutionProvider\), .* off", tried[-1].text)

    golden = dict(np.load(version / "golden.npz"))
    np.savez(version / "golden.npz", **(golden | {"translation_m": golden["translation_m"] + 0.01}))
    (_, *tried) = examine_files(Subjects(model=version))
    assert (tried[-1].subject, tried[-1].state) == ("model on cpu", "bad")
    assert tried[-1].text.endswith("0.01 off, where at most 0.001 is accepted")

    (version / "golden.npz").write_bytes(b"no archive")
    (_, *tried) = examine_files(Subjects(model=version / "model.onnx"))
    assert "golden.npz is not an archive of arrays" in tried[-1].text

    (version / "golden.npz").unlink()
    assert [finding.text for finding in examine_files(Subjects(model=version))][1:] == [
        "not compared: there is no golden.npz beside model.onnx"
    ]


def test_kinds_of_photographs_that_are_not_served(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    random = np.random.default_rng(0)
    for name in ("a.png", "b.bmp", "c.tif"):
        cv2.imwrite(str(tmp_path / name), random.integers(0, 255, (60, 80, 3), dtype=np.uint8))
    _, findings = run(["--photos", str(tmp_path)], capsys)
    assert findings["photograph kind"].startswith("warning 2 are BMP or TIFF (b.bmp and 1 more)")
