"""Serving and detection work where nothing of training can be imported."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest
from curio_serve.client import PoseClient

BLOCKED = ("torch", "mitsuba", "drjit", "onnx", "onnxscript", "trimesh", "curio_train")
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
    """Environment variables under which every Python process refuses the packages of training."""
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
