"""Serving and detection work where nothing that the base install leaves out can be imported."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest
from curio_serve.client import PoseClient

ROOT = Path(__file__).parents[2]
BLOCKED = (
    "torch",
    "mitsuba",
    "drjit",
    "onnx",
    "onnxscript",
    "trimesh",
    "scipy",
    "skimage",
    "matplotlib",
    "PIL",
    "curio_train",
)
REFUSING = f"""
import sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {BLOCKED}:
            raise ImportError(name + " is blocked in this test")

sys.meta_path.insert(0, Blocked())
"""


@pytest.fixture(scope="module")
def blocked(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, str]:
    """Environment variables under which every Python process refuses these packages."""
    folder = tmp_path_factory.mktemp("hook")
    (folder / "sitecustomize.py").write_text(REFUSING)
    return {"PYTHONPATH": str(folder)}


@pytest.mark.parametrize("package", BLOCKED)
def test_the_block_holds(blocked: Mapping[str, str], package: str) -> None:
    command = [sys.executable, "-c", f"import {package}"]
    done = subprocess.run(command, env=os.environ | blocked, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "is blocked in this test" in done.stderr


def test_detection_works(
    models: Path,
    frames: list[Path],
    blocked: Mapping[str, str],
    call: Callable[..., "subprocess.CompletedProcess[str]"],
) -> None:
    done = call("curio-detect", models / "circles", frames[0].parent, extra=blocked)
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert [len(row["detections"]) for row in rows] == [1] * len(frames)


def test_the_server_works(
    models: Path, frames: list[Path], blocked: Mapping[str, str], serving: Callable[..., object]
) -> None:
    with serving(models, extra=blocked) as address, PoseClient(address) as client:
        assert len(client.detect("circles", frames[0]).results[0].detections) == 1


@pytest.mark.parametrize("through", ["track", "rig"])
def test_following_and_rigs_work(
    through: str, tmp_path: Path, blocked: Mapping[str, str], call: Callable[..., "subprocess.CompletedProcess[str]"]
) -> None:
    samples = ROOT / "samples"
    flags: list[str | Path] = [samples, "--camera", samples / "camera.json", "--track"]
    if through == "rig":
        camera = json.loads((samples / "camera.json").read_text())
        cameras = [camera | {"name": str(x), "cam_from_rig": beside(x)} for x in (0.0, 0.1)]
        (tmp_path / "rig.json").write_text(json.dumps({"cameras": cameras}))
        flags = [samples / "00.jpg", samples / "01.jpg", "--rig", tmp_path / "rig.json"]
    done = call("curio-detect", ROOT / "models" / "ape", *flags, extra=blocked)
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(rows) == (1 if through == "rig" else 4)
    assert all(row["detections"] for row in rows)


def beside(x_m: float) -> list[list[float]]:
    """cam_from_rig, [4][4], of a camera that looks along the rig's axis, x_m to the left of it."""
    return [[1, 0, 0, x_m], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
