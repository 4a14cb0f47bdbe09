"""``curio-detect`` through a server: the same results as without one, and what happens when it goes."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from curio_serve.batch.arguments import DetectArguments
from curio_serve.batch.detect_cli import run
from curio_serve.errors import ModelNotFound, TokenError, Unavailable, UsageError
from PIL import Image

K = [[300.0, 0, 160.0], [0, 301.0, 119.0], [0, 0, 1]]


def detect(model: Path | str, *sources: Path, **flags: Any) -> int:
    if flags.get("out") is not None:
        flags["out"] = str(flags["out"])
    return run(DetectArguments(str(model), tuple(map(str, sources)), **flags))


def without_times(out: Path) -> list[dict[str, Any]]:
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    for line in lines:
        del line["milliseconds"]
    return lines


@pytest.fixture
def frames(tmp_path: Path, spot_image: Callable[..., np.ndarray]) -> Path:
    """Four frames and a file that is none."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for number in range(4):
        pixels = spot_image(320, 240, 100 + 20 * number, 120, 12, 12, (255, 128, 0))
        cv2.imwrite(str(folder / f"{number:06d}.jpg"), pixels[..., ::-1])
    (folder / "000009.jpg").write_bytes(b"nothing")
    return folder


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({"camera_matrix": K, "width": 320, "height": 240}))
    return path


@pytest.mark.parametrize("flags", [{}, {"exif_rotation": True}, {"max_detections": 1, "min_confidence": 0.5}])
def test_file_and_server_write_the_same(
    flags: dict[str, Any], server: Any, models_dir: Path, frames: Path, camera: Path, tmp_path: Path
) -> None:
    local, remote = tmp_path / "local.jsonl", tmp_path / "remote.jsonl"
    flags = {"camera": camera, **flags}
    assert detect(models_dir / "pinhole", frames, out=local, overlays=tmp_path / "one", **flags) == 1
    assert detect(f"{server.address}/pinhole", frames, out=remote, overlays=tmp_path / "other", **flags) == 1
    assert len(without_times(local)) == 5
    assert without_times(local) == without_times(remote)
    assert (tmp_path / "one/000001.jpg").read_bytes() == (tmp_path / "other/000001.jpg").read_bytes()


def test_photographs_are_sent_as_they_are_stored_and_turned_there(
    start_server: Callable[..., Any], models_dir: Path, camera: Path, frames: Path, tmp_path: Path
) -> None:
    """Their pixels would be larger than the server accepts."""
    small = start_server(models_dir, "--max-message-mb", "1")
    pixels = cv2.resize(cv2.imread(str(frames / "000001.jpg")), (1280, 960))
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(pixels[..., ::-1]).save(frames / "000001.jpg", exif=exif)
    camera.write_text(json.dumps({"camera_matrix": (np.diag([4.0, 4, 1]) @ K).tolist(), "width": 1280, "height": 960}))
    lines = []
    for model in (str(models_dir / "pinhole"), f"{small.address}/pinhole"):
        out = tmp_path / "out.jsonl"
        detect(model, frames / "000001.jpg", camera=camera, out=out, exif_rotation=True, overwrite=True)
        lines += without_times(out)
    assert lines[0] == lines[1]
    assert (lines[0]["width"], lines[0]["exif_rotation"]) == (960, True)


def test_a_server_without_a_call_left_is_asked_again(
    start_server: Callable[..., Any], models_dir: Path, frames: Path, tmp_path: Path
) -> None:
    busy = start_server(models_dir, "--max-calls", "1", "--workers", "1")
    for number in range(10, 30):
        (frames / f"{number:06d}.jpg").write_bytes((frames / "000001.jpg").read_bytes())
    detect(f"{busy.address}/flat", frames, out=tmp_path / "out", jobs=6)
    errors = [line["error"] for line in without_times(tmp_path / "out") if "error" in line]
    assert len(errors) == 1, "the file that is no image"


def test_flags_for_servers_are_refused_without_one(models_dir: Path, frames: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--token-file .* is for a model on a server"):
        detect(models_dir / "flat", frames, token_file=tmp_path / "none")


def test_a_version_may_be_named(server: Any, frames: Path, tmp_path: Path) -> None:
    assert detect(f"{server.address}/flat/1", frames, out=tmp_path / "out") == 1
    with pytest.raises(ModelNotFound, match="flat"):
        detect(f"{server.address}/flat/7", frames)
    with pytest.raises(ModelNotFound, match="none"):
        detect(f"{server.address}/none", frames)


def test_a_path_that_exists_wins(
    server: Any, models_dir: Path, frames: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / server.address).mkdir()
    (tmp_path / server.address / "pinhole").symlink_to(models_dir / "flat")
    assert detect(f"{server.address}/pinhole", frames, out=tmp_path / "out") == 1  # flat: no camera needed


def test_k_is_asked_for_before_the_start(server: Any, frames: Path) -> None:
    with pytest.raises(UsageError, match="--camera FILE"):
        detect(f"{server.address}/pinhole", frames)


def test_a_server_with_a_token(
    start_server: Callable[..., Any], models_dir: Path, frames: Path, tmp_path: Path
) -> None:
    token = tmp_path / "token"
    token.write_text("open-sesame\n")
    guarded = start_server(models_dir, "--token-file", str(token))
    assert detect(f"{guarded.address}/flat", frames, out=tmp_path / "out", token_file=token) == 1
    with pytest.raises(TokenError):
        detect(f"{guarded.address}/flat", frames)
    with pytest.raises(UsageError, match="--token-file"):
        detect(f"{guarded.address}/flat", frames, token_file=tmp_path / "none")


def test_no_server_is_said_soon(frames: Path) -> None:
    with pytest.raises(Unavailable, match=r"127\.0\.0\.1:9 "):
        detect("127.0.0.1:9/flat", frames)


def test_a_server_that_is_replaced_costs_nothing_but_time(
    start_server: Callable[..., Any], models_dir: Path, frames: Path, tmp_path: Path
) -> None:
    """The server is killed in the midst of a run and another takes its port: every image is answered, none twice."""
    many, out = tmp_path / "many", tmp_path / "out.jsonl"
    many.mkdir()
    for number in range(800):
        os.link(frames / f"{number % 4:06d}.jpg", many / f"{number:04d}.jpg")
    first = start_server(models_dir)
    program = "from curio_serve.batch.detect_cli import main; main()"
    call = [sys.executable, "-c", program, f"{first.address}/flat", str(many), "--out", str(out)]
    with subprocess.Popen(call, stderr=subprocess.PIPE, text=True) as process:
        while not out.exists() or out.read_bytes().count(b"\n") < 50:
            assert process.poll() is None, process.communicate()
            time.sleep(0.005)
        first.stop(signal.SIGKILL)
        start_server(models_dir, "--port", first.address.rpartition(":")[2])
        told = process.communicate()[1]
    assert process.returncode == 0, told
    lines = without_times(out)
    assert [Path(line["image"]).name for line in lines] == [f"{number:04d}.jpg" for number in range(800)]
    assert not any("error" in line for line in lines)
