"""The paper's Table 4 on synthetic captures: make photographs, learn from them, judge from a second camera.

    python benchmarks/captures.py [--only sphere_real] [--methods noncur our] [--images 16000] [--jobs 2] [--dry-run]

What is there already is kept: photographs, finished runs, checkpoints. After each run docs/results/captures.json and
captures.md are written anew. Every method of a scene sees as many images.
"""

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from curio_train.commands.command_line.running import answer
from paper.captures_table import METHODS, Table, markdown, row
from paper.results import load_rows, save_results
from paper.run_queue import QueuedRun, carry_out
from synthetic_captures.captures import Amount, make

Scene = Literal["sphere_real", "bunny", "shapes"]
Method = Literal["noncur", "our", "sleep", "sleep_cells"]

_PARTS = {
    "sphere_real": (["sphere"], ["--counts", "3"]),
    "bunny": (["bunny"], ["--lying"]),
    "shapes": (["capsule", "box", "cone"], ["--counts", "1-4", "2-4", "2-4"]),
}

_BATCH_SIZE = 32  # twice the steps of the preset's, which such small budgets need


@dataclass(frozen=True)
class Settings:
    """What to run.

    Attributes:
        only: Scenes.
        methods: Rows of the table.
        images: Every run's budget.
        photos: To learn from, of each scene.
        tests: Scenes seen from both cameras.
        jobs: Runs at once, each with its share of the cores.
        runs: Where photographs and run folders lie.
        results: The file of results; the table lies beside it.
        dry_run: Say what would be run, and write the table of what is there.
    """

    only: tuple[Scene, ...] = ("sphere_real", "bunny", "shapes")
    methods: tuple[Method, ...] = ("noncur", "sleep", "sleep_cells", "our")
    images: int = 16_000
    photos: int = 200
    tests: int = 50
    jobs: int = min(2, len(os.sched_getaffinity(0)))
    runs: Path = Path("runs/captures")
    results: Path = Path("docs/results/captures.json")
    dry_run: bool = False


def plan(settings: Settings) -> dict[tuple[str, str], QueuedRun]:
    """All runs by scene and method: a method in all scenes before the next."""
    return {(scene, method): _run(settings, scene, method) for method in settings.methods for scene in settings.only}


def _run(settings: Settings, scene: str, method: str) -> QueuedRun:
    files = settings.runs / "scenes" / scene
    names, amounts = _PARTS[scene]
    flags = ["--mesh", *(str(files / "meshes" / f"{name}.stl") for name in names), "--mesh-unit", "m", "--up", "y"]
    flags += [*amounts, "--camera", str(files / "camera.json"), "--photos", str(files / "photos")]
    flags += ["--plane", str(files / "views.json"), "--background", str(files / "plates" / "a-0.png")]
    flags += ["--held-out", str(files / "test" / "a"), "--second", str(files / "test" / "b")]
    flags += ["--second-background", str(files / "plates" / "b.png"), "--method", method.removesuffix("_cells")]
    flags += ["--reading", "cells" if method.endswith("_cells") else "whole"]
    flags += ["--batch-size", str(_BATCH_SIZE), "--micro-batch-size", str(_BATCH_SIZE)]
    folder = settings.runs / f"{scene}-{settings.images}" / method
    name = f"{scene} {method}, {settings.images:,} images"
    return QueuedRun(name, folder, "capture", settings.images, flags, scoring=["--num-images", "50"])


def write(settings: Settings, runs: dict[tuple[str, str], QueuedRun]) -> None:
    """The table of all runs that are done, and of earlier ones with their budget."""
    table: Table = load_rows(settings.results, {"sharp", "blurred", "plate", "images_seen"}, "results of captures")
    for (scene, method), run in runs.items():
        if run.done:
            table.setdefault(scene, {})[method] = row(run.evaluation)
    table = {
        scene: {method: table[scene][method] for method in METHODS if method in table[scene]}
        for scene in _PARTS
        if scene in table
    }
    if table:
        save_results(settings.results, table)
        text = markdown(table, "python benchmarks/captures.py")
        settings.results.with_suffix(".md").write_text(text, encoding="utf-8")


def main(settings: Settings) -> int:
    """Make what is missing, carry out what is left."""
    runs = plan(settings)
    write(settings, runs)
    if settings.dry_run:
        for run in runs.values():
            print(f"{'done' if run.done else 'to do'}: {run.name}: {run.folder}")
        return 0
    for scene in settings.only:
        make(scene, settings.runs / "scenes", Amount(settings.photos, settings.tests), _show)
    print(file=sys.stderr)
    return carry_out(list(runs.values()), settings.jobs, lambda: write(settings, runs))


def _show(text: str) -> None:
    print(f"\r{text}", end="", file=sys.stderr)


if __name__ == "__main__":
    chosen = tyro.cli(Settings, description=__doc__)
    sys.exit(answer(lambda _: main(chosen)))
