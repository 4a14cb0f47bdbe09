"""The demo, with a budget of two steps: everything but the learning."""

import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
from demo import progress

DEMO = Path(__file__).parents[2] / "benchmarks" / "demo.py"


def run(out: Path, home: Path) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, str(DEMO), "--images", "128", "--out", str(out), "--json"]
    environment = os.environ | {"HOME": str(home)}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def test_demo_measures_three_networks_and_draws_two(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    (out / "our").mkdir(parents=True)
    (out / "our" / "config.json").write_text("of an earlier demo")
    done = run(out, tmp_path)
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout.splitlines()[-1])
    assert json.loads((out / "demo.json").read_text()) == figures
    assert figures["num_frames"] == 500
    assert figures["images_seen"] == {"noncur": 128, "our": 128}
    pixels, widths = figures["position_error_px"], figures["position_error_image_widths"]
    assert pixels.keys() == widths.keys() == {"untrained", "noncur", "our"}
    assert len(set(pixels.values())) == 3, "three networks give three figures"
    for name, error in pixels.items():
        assert error == 128 * widths[name]
        assert 20 < error < 91, "two steps from the untrained network: about as far off as a guess"
    assert cv2.imread(str(out / "demo.png")).shape[0] == 2 * 260


def test_progress_is_the_last_image_loss_whatever_else_was_written_after_it(tmp_path: Path) -> None:
    assert progress(tmp_path) == "…"
    rows = [{"step": 20, "images": 1280, "image": 833.8}, {"step": 39, "images": 2496, "image_dssim": 0.02}]
    (tmp_path / "history.jsonl").write_text("".join(f"{json.dumps(row)}\n" for row in rows) + '{"step": 40, "ima')
    assert progress(tmp_path) == "1,280 images, image loss 834"


def test_demo_says_which_command_failed(tmp_path: Path) -> None:
    (tmp_path / ".cache").write_text("in the way of every cache")
    done = run(tmp_path / "demo", tmp_path)
    assert done.returncode == 1
    assert "training" in done.stderr
    assert "cannot write" in done.stderr
    assert "Traceback" not in done.stderr
