"""``curio-detect --ray local``: the same lines from a cluster of this machine, and what happens without Ray."""

import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed: extra `ray`")


def detect(*arguments: str | Path) -> "subprocess.CompletedProcess[str]":
    """In a process of its own: Ray leaves threads and handlers behind."""
    program = "from curio_serve.batch.detect_cli import main; main()"
    call = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.run(call, capture_output=True, text=True, env=os.environ)


def without_times(out: Path) -> list[dict[str, Any]]:
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    for line in lines:
        del line["milliseconds"]
    return lines


@pytest.fixture
def frames(tmp_path: Path, spot_image: Callable[..., np.ndarray]) -> Path:
    """200 frames and a file that is none."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for number in range(4):
        pixels = spot_image(320, 240, 100 + 20 * number, 120, 12, 12, (255, 128, 0))
        cv2.imwrite(str(folder / f"{number:04d}.png"), pixels[..., ::-1])
    for number in range(4, 200):
        os.link(folder / f"{number % 4:04d}.png", folder / f"{number:04d}.png")
    (folder / "0100b.png").write_bytes(b"nothing")
    return folder


@needs_ray
def test_a_cluster_writes_the_same_lines_and_goes_on_after_a_stop(
    models_dir: Path, frames: Path, tmp_path: Path
) -> None:
    here, there = tmp_path / "here.jsonl", tmp_path / "there.jsonl"
    assert detect(models_dir / "flat", frames, "--out", here).returncode == 1
    lines = here.read_bytes().splitlines(keepends=True)
    there.write_bytes(b"".join(lines[:50]) + lines[50][:40])  # as a stop would leave it
    done = detect(models_dir / "flat", frames, "--out", there, "--ray", "local")
    assert done.returncode == 1, done.stderr
    assert "1 image has no answer" in done.stderr
    assert without_times(there) == without_times(here)
    assert done.stdout == ""


@needs_ray
def test_a_cluster_out_of_reach_is_said(models_dir: Path, frames: Path) -> None:
    done = detect(models_dir / "flat", frames, "--ray", "127.0.0.1:9")
    assert done.returncode == 1
    assert "curio-detect: error: --ray 127.0.0.1:9: no cluster" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.skipif(importlib.util.find_spec("ray") is not None, reason="Ray is installed")
def test_without_ray_it_says_what_to_install(models_dir: Path, frames: Path) -> None:
    done = detect(models_dir / "flat", frames, "--ray", "local")
    assert done.returncode == 2
    assert "pip install 'curio-pose[ray]'" in done.stderr
