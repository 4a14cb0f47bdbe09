"""What ``curio-detect`` costs over the bare loop, on a folder of 2,000 frames.

    python benchmarks/detection.py [--json] [--frames 2000] [--rounds 3]

detect_over_bare  images a second of the whole command, from its start to its exit, over those of a bare loop (read,
                  decode, warp, session; one thread a core), likewise a process; median of alternating rounds
images_per_s      of the command
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from load.generator import HEIGHT, MODEL, WIDTH, K, make_frames
from load.network import write_model

_BARE = (
    "import sys; sys.path.insert(0, sys.argv[1]); from load.generator import bare_folder; bare_folder(*sys.argv[2:])"
)
_DETECT = "from curio_serve.batch.detect_cli import main; main()"


@dataclass(frozen=True)
class Arguments:
    """Measure what curio-detect costs over the bare loop."""

    json: bool = False
    """Print one JSON object on the last line instead of a table."""
    frames: int = 2000
    """Images in the folder."""
    rounds: int = 3
    """How often both are measured in turn."""


def main() -> None:
    """Measures, prints, and leaves nothing behind."""
    arguments = tyro.cli(Arguments)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_model(folder / MODEL, K, WIDTH)
        camera = {"camera_matrix": K.tolist(), "width": WIDTH, "height": HEIGHT}
        (folder / "camera.json").write_text(json.dumps(camera))
        (folder / "frames").mkdir()
        encoded = make_frames()
        for number in range(arguments.frames):
            (folder / "frames" / f"{number:06d}.jpg").write_bytes(encoded[number % len(encoded)])
        bare_s, detect_s = zip(*(measure(folder) for _ in range(arguments.rounds)), strict=True)
    figures = {
        "detect_over_bare": round(statistics.median(np.divide(bare_s, detect_s)), 3),
        "images_per_s": round(arguments.frames / statistics.median(detect_s), 1),
        "bare_images_per_s": round(arguments.frames / statistics.median(bare_s), 1),
    }
    print(json.dumps(figures) if arguments.json else "\n".join(f"{k:18} {v}" for k, v in figures.items()))


def measure(folder: Path) -> tuple[float, float]:
    """Seconds of the bare loop and of the command, each with its start."""
    frames, camera = str(folder / "frames"), str(folder / "camera.json")
    here, num_threads = str(Path(__file__).parent), str(len(os.sched_getaffinity(0)))
    bare = [_BARE, here, str(folder / MODEL), frames, num_threads]
    detect = [_DETECT, str(folder / MODEL), frames, "--camera", camera, "--out", str(folder / "out"), "--overwrite"]
    return elapsed_s(bare), elapsed_s(detect)


def elapsed_s(program: list[str]) -> float:
    """Seconds of a Python program from start to exit."""
    begun = time.perf_counter()
    subprocess.run([sys.executable, "-c", *program], check=True, stderr=subprocess.DEVNULL)
    return time.perf_counter() - begun


if __name__ == "__main__":
    main()
