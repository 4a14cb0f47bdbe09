"""curio-detect --video: overlays in the browser, frames that come too fast are dropped and counted."""

import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from curio_serve.batch.live import LatestFrame
from curio_serve.errors import UsageError

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
NUM_FRAMES, RATE = 30, 10


def write_clip(path: Path, num_frames: int) -> Path:
    """A grey that grows lighter, and starts again."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), RATE, (320, 240))
    for number in range(num_frames):
        writer.write(np.full((240, 320, 3), 4 * (number % NUM_FRAMES), np.uint8))
    writer.release()
    return path


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three seconds."""
    return write_clip(tmp_path_factory.mktemp("live") / "clip.mp4", NUM_FRAMES)


def detect(*arguments: object) -> subprocess.Popen[str]:
    script = "from curio_serve.batch.detect_cli import main; main()"
    command = [sys.executable, "-c", script, *map(str, arguments)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


def test_a_slow_reader_gets_the_newest_frame(clip: Path) -> None:
    levels = []
    with LatestFrame(str(clip)) as frames:
        while (frame := frames.take()) is not None:
            levels.append(int(frame.mean()))
            time.sleep(0.5)  # five frames of the clip
    assert frames.num_read == NUM_FRAMES
    assert len(levels) == frames.num_taken < NUM_FRAMES / 2
    assert levels == sorted(levels)
    assert min(np.diff(levels)) > 4  # more than one frame apart


def test_a_video_is_shown_to_its_end(models_dir: Path, clip: Path) -> None:
    process = detect(models_dir / "flat", "--video", clip, "--port", free_port())
    _, err = process.communicate(timeout=60)
    assert process.returncode == 0
    assert "http://127.0.0.1:" in err
    shown, dropped = (int(word) for word in err.split() if word.isdigit())
    assert shown + dropped == NUM_FRAMES
    assert shown > 0


@pytest.mark.skipif(BROWSER is None, reason="no chromium on this machine; .ci/run installs it")
def test_the_page_shows_rates_and_detections(models_dir: Path, tmp_path: Path) -> None:
    playwright = pytest.importorskip("playwright.sync_api")
    port, clip = free_port(), write_clip(tmp_path / "long.mp4", 900)  # longer than a browser takes to start
    process = detect(models_dir / "flat", "--video", clip, "--port", port)
    assert process.stderr is not None
    assert f"http://127.0.0.1:{port}" in process.stderr.readline()
    with playwright.sync_playwright() as started:
        options = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = started.chromium.launch(executable_path=BROWSER, args=options)
        page = browser.new_page()
        page.goto(f"http://127.0.0.1:{port}")
        page.get_by_text("frames a second").wait_for(timeout=30_000)
        page.get_by_text("confidence").first.wait_for(timeout=30_000)
        browser.close()
    process.terminate()
    process.communicate(timeout=30)


@pytest.mark.parametrize("source", ["none.mp4", "99", "²", "99999999999999999999"])
def test_a_source_that_is_not_there(source: str) -> None:
    with pytest.raises(UsageError, match="cannot be opened"):
        LatestFrame(source)


def test_calls_that_cannot_be(models_dir: Path, clip: Path, tmp_path: Path) -> None:
    process = detect(models_dir / "flat", tmp_path, "--video", clip)
    assert "leave out IMAGES" in process.communicate(timeout=60)[1]
    with socket.create_server(("127.0.0.1", 0)) as taken:
        process = detect(models_dir / "flat", "--video", clip, "--port", taken.getsockname()[1])
        assert "cannot listen on 127.0.0.1" in process.communicate(timeout=60)[1]
    assert process.returncode == 2


@pytest.mark.parametrize(
    ("flags", "told"),
    [
        (["--video", "0", "--track"], "--track has no effect on --video"),
        (["--video", "0", "--format", "bop"], "--format has no effect on --video"),
        (["photo.jpg", "--port", "8081"], "are of the page that --video makes"),
    ],
)
def test_flags_without_effect_are_refused(models_dir: Path, flags: list[str], told: str) -> None:
    process = detect(models_dir / "flat", *flags)
    assert told in process.communicate(timeout=60)[1]
    assert process.returncode == 2
