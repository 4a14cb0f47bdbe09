"""From images without labels to positions over gRPC, in one command: `make demo`.

    python benchmarks/demo.py [--json] [--images 12800] [--seed 0] [--out runs/demo]

Trains the circles world twice on the same budget of images, with the paper's curiosity (`our`) and with the image loss
alone (`noncur`), exports both, serves them, and asks the server for the circle's position in 500 held-out frames.
Everything runs through the installed commands, as a user would call them.

position_error_px             mean distance of the position from the truth, pixels of 128; also of the untrained network
position_error_image_widths   the same in image widths
grpc_ms_median                one frame, both models, there and back
"""

import json
import os
import shutil
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tyro
from curio_serve.client import PoseClient
from curio_train.learning.runs.progress import read_history
from rich.console import Console
from rich.table import Table

METHODS = ("noncur", "our")
_NUM_DRAWN = 8
_ENLARGED = 2
_STOP_LIMIT_S = 30


@dataclass(frozen=True)
class Arguments:
    """Train, export, serve and measure the circles world."""

    json: bool = False
    """Print one JSON object on the last line."""
    images: int = 12_800
    """Training images shown to each method."""
    minutes: float = 4.8
    """Training ends then at the latest, on machines that are too slow for the images."""
    seed: int = 0
    """Of both runs."""
    out: Path = Path("runs/demo")
    """Folder for runs, models, frames and results; what an earlier demo left there is replaced."""


class DemoFailed(Exception):
    """One of the commands did not do its work."""


def main() -> None:
    """Does it all; exit status 1 where a command failed."""
    arguments = tyro.cli(Arguments)
    console = Console(stderr=True, highlight=False)
    try:
        figures = demonstrate(arguments, console)
    except DemoFailed as exc:
        console.print(f"demo: {exc}", style="bold red", markup=False, soft_wrap=True)
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)
    print_table(figures)
    if arguments.json:
        print(json.dumps(figures))


def demonstrate(arguments: Arguments, console: Console) -> dict[str, Any]:
    """The whole path; every figure is measured."""
    start = time.monotonic()
    out = arguments.out
    for name in (*METHODS, "models", "frames"):
        shutil.rmtree(out / name, ignore_errors=True)
    out.mkdir(parents=True, exist_ok=True)

    console.print(f"training {' and '.join(METHODS)} side by side, {arguments.images:,} images each")
    train(arguments, console)
    console.print("evaluating and exporting")
    evaluations = {method: evaluate(out / method) for method in METHODS}
    for method in METHODS:
        call("curio-export", str(out / method), "--out", str(out / "models"), "--name", method)
    frames, truth = write_frames(out / "frames")
    console.print(f"serving, and sending {len(frames)} held-out frames")
    with server(out / "models") as address:
        found, latencies = ask(address, frames)

    errors = {"untrained": evaluations["our"]["untrained"]["position_image_widths"]}
    errors |= {method: float(np.linalg.norm(found[method] - truth, axis=1).mean()) for method in METHODS}
    draw(out / "demo.png", frames, found)
    figures = {
        "position_error_px": {name: error * 128 for name, error in errors.items()},
        "position_error_image_widths": errors,
        "images_seen": {method: evaluations[method]["images_seen"] for method in METHODS},
        "training_seconds": {method: evaluations[method]["training_seconds"] for method in METHODS},
        "num_frames": len(frames),
        "grpc_ms_median": statistics.median(latencies),
        "seed": arguments.seed,
        "commit": evaluations["our"]["commit"],
        "machine": evaluations["our"]["machine"],
        "total_seconds": round(time.monotonic() - start, 1),
    }
    (out / "demo.json").write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    console.print(f"pictures in {out / 'demo.png'}, figures in {out / 'demo.json'}")
    return figures


def command(name: str) -> str:
    """Path of a command installed beside this Python."""
    return str(Path(sys.executable).with_name(name))


def call(name: str, *arguments: str) -> str:
    """Run a command to its end and return what it printed."""
    done = subprocess.run([command(name), *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise DemoFailed(f"{name} {' '.join(arguments)} ended with status {done.returncode}: {done.stderr.strip()}")
    return done.stdout


def train(arguments: Arguments, console: Console) -> None:
    """Both methods at once, each on its share of the cores: the same conditions, and no core idles."""
    num_threads = max(1, len(os.sched_getaffinity(0)) // len(METHODS))
    environment = os.environ | {"OMP_NUM_THREADS": str(num_threads)}
    with ExitStack() as stack:
        runs = {}
        for method in METHODS:
            log = stack.enter_context((arguments.out / f"{method}.log").open("w", encoding="utf-8"))
            flags = ["--method", method, "--seed", str(arguments.seed), "--images", str(arguments.images)]
            flags += ["--minutes", str(arguments.minutes), "--out", str(arguments.out / method)]
            run = [command("curio-train"), "circles", *flags]
            runs[method] = stack.enter_context(ended(subprocess.Popen(run, env=environment, stdout=log, stderr=log)))
        watch(arguments, runs, console)
    for method, process in runs.items():
        if process.returncode:
            said = (arguments.out / f"{method}.log").read_text(encoding="utf-8").strip()
            raise DemoFailed(f"training {method} ended with status {process.returncode}: {said[-2000:]}")


def watch(arguments: Arguments, runs: dict[str, "subprocess.Popen[bytes]"], console: Console) -> None:
    """Say how far the runs are until all have ended, or one has failed."""
    interval_s, said_at = (1.0 if console.is_terminal else 20.0), time.monotonic()
    with console.status("starting") as status:
        while any(run.poll() is None for run in runs.values()) and not any(run.returncode for run in runs.values()):
            time.sleep(0.2)
            if time.monotonic() - said_at > interval_s:
                said_at = time.monotonic()
                text = ", ".join(f"{method} {progress(arguments.out / method)}" for method in runs)
                status.update(text)
                if not console.is_terminal:
                    console.print(text)


def progress(run: Path) -> str:
    """The last image loss in a run's history, in words; other lines say other things."""
    rows = [row for row in read_history(run) if "image" in row]
    return f"{rows[-1]['images']:,} images, image loss {rows[-1]['image']:.0f}" if rows else "…"


@contextmanager
def ended(process: "subprocess.Popen[Any]") -> Iterator["subprocess.Popen[Any]"]:
    """The process, which does not outlive the block."""
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
            process.wait(timeout=_STOP_LIMIT_S)


def evaluate(run: Path) -> dict[str, Any]:
    """What curio-eval says of a run."""
    result: dict[str, Any] = json.loads(call("curio-eval", str(run), "--json").splitlines()[-1])
    return result


def write_frames(folder: Path) -> tuple[list[Path], np.ndarray]:
    """The test split as PNG files, and the true positions [num_frames, 2] in image widths."""
    from curio_train.scene_code import TRANSLATION
    from curio_train.worlds.generated.circles import Circles

    folder.mkdir(parents=True)
    source = Circles().source("test", 0, with_code=True, cache=Path("~/.cache/curio-pose"))
    paths = [folder / f"{number:04d}.png" for number in range(len(source))]
    for path, image in zip(paths, source.images.permute(0, 2, 3, 1).numpy(), strict=True):
        cv2.imwrite(str(path), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    assert source.code is not None  # asked for above
    return paths, source.code[TRANSLATION][:, 0, :2].numpy()


@contextmanager
def server(models: Path) -> Iterator[str]:
    """A real server on a free port of the loopback, until SIGTERM ends it."""
    run = [command("curio-serve"), str(models), "--port", "0", "--log-level", "error"]
    with ended(subprocess.Popen(run, stdout=subprocess.PIPE, text=True)) as process:
        assert process.stdout is not None
        said = process.stdout.readline()
        if not said.startswith("listening on "):
            raise DemoFailed(f"curio-serve did not start: status {process.wait()}")
        yield said.split()[-1]
        process.send_signal(signal.SIGTERM)
        status = process.wait(timeout=_STOP_LIMIT_S)
        if status:
            raise DemoFailed(f"curio-serve ended with status {status} on SIGTERM, expected 0")


def ask(address: str, frames: list[Path]) -> tuple[dict[str, np.ndarray], list[float]]:
    """Positions [num_frames, 2] that each model finds, and milliseconds a call."""
    found: dict[str, list[list[float]]] = {method: [] for method in METHODS}
    latencies = []
    with PoseClient(address) as client:
        for frame in frames:
            start = time.perf_counter()
            answer = client.detect(METHODS, frame)
            latencies.append(1000 * (time.perf_counter() - start))
            for result in answer.results:
                found[result.model].append(list(result.detections[0].translation_m[:2]))
    return {method: np.array(positions) for method, positions in found.items()}, latencies


def draw(path: Path, frames: list[Path], found: dict[str, np.ndarray]) -> None:
    """A sheet: a row a method, a few frames with the circle drawn where the server says it is."""
    rows = []
    for method in METHODS:
        tiles = []
        for frame, position in zip(frames[:_NUM_DRAWN], found[method], strict=False):
            image = cv2.resize(cv2.imread(str(frame)), None, fx=_ENLARGED, fy=_ENLARGED, interpolation=cv2.INTER_CUBIC)
            side = image.shape[1]
            centre = np.round((position + 0.5) * side - 0.5).astype(int).tolist()
            cv2.circle(image, centre, round(0.1 * side), (255, 255, 255), 2, cv2.LINE_AA)
            cv2.drawMarker(image, centre, (255, 255, 255), cv2.MARKER_CROSS, 12, 1, cv2.LINE_AA)
            tiles.append(cv2.copyMakeBorder(image, 2, 2, 2, 2, cv2.BORDER_CONSTANT, value=(96, 96, 96)))
        label = np.full((tiles[0].shape[0], 130, 3), 24, np.uint8)
        cv2.putText(label, method, (10, label.shape[0] // 2), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (255, 255, 255), 2)
        rows.append(np.hstack([label, *tiles]))
    if not cv2.imwrite(str(path), np.vstack(rows)):
        raise DemoFailed(f"cannot write {path}; is the disk full?")


def print_table(figures: dict[str, Any]) -> None:
    """For people, on stdout."""
    table = Table(
        title=f"position error over gRPC, mean of {figures['num_frames']} held-out frames", title_justify="left"
    )
    for name in ("method", "pixels of 128", "image widths", "images seen", "training"):
        table.add_column(name, justify="left" if name == "method" else "right")
    for name, error in figures["position_error_px"].items():
        seen, seconds = figures["images_seen"].get(name, 0), figures["training_seconds"].get(name, 0)
        widths = figures["position_error_image_widths"][name]
        table.add_row(name, f"{error:.2f}", f"{widths:.4f}", f"{seen:,}", f"{seconds / 60:.1f} minutes")
    Console().print(table)
    print(f"{figures['grpc_ms_median']:.1f} ms a call of both models; {figures['total_seconds']:.0f} s in all")


if __name__ == "__main__":
    main()
