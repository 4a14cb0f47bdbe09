"""The paper's Tables 2 and 3: every method in every world, run by run, as far as they are not there yet.

    python benchmarks/results.py [--only circles spheres] [--methods our noncur] [--images N] [--seeds 0 1 2]
                                 [--jobs 2] [--dry-run]

Each run is trained and scored in a folder of its own under ``runs/results``; after each, docs/results/worlds.json,
worlds.md and worlds.png are written anew. Stop it at any time: the same command goes on where it stopped, in the middle
of a run, too. Every method of a world sees as many images, ``our_found_cells`` as many again as the run it begins as.
"""

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from curio_train.commands.command_line.running import answer
from curio_train.config import PRESETS
from curio_train.errors import UsageError
from paper.results import ORDER, WORLDS, collect, load_results, merge, save_results
from paper.run_queue import QueuedRun, carry_out

World = Literal["circles", "spheres", "chairs", "varied", "multi", "light"]

# Images that every method of a world sees with preset laptop. Full supervision learns a world's 2,000 images by heart
# within 32,000 and is no better after 96,000 (docs/experiments/).
BUDGETS = {"circles": 48_000, "spheres": 32_000, "chairs": 32_000, "varied": 32_000, "multi": 32_000, "light": 32_000}
SEVERAL_SEEDS = {
    "circles": {"super_1.0", "noncur", "our"},
    "spheres": {"super_1.0", "noncur", "our", "noncur_cells", "our_cells"},
    "chairs": {"noncur_cells", "our_cells"},
    "varied": {"noncur_cells", "our_cells"},
}
_HYPOTHESES, _FOUND = ("hypotheses_cells", "our_found_cells"), "_found"  # of objects that stand on the ground
_STANDING = {"chairs", "multi", "light"}
_RATES = ("--learning-rate", "1e-4", "--critic-learning-rate", "1e-6")  # the paper's; higher ones leave found scenes
_CELLS = ("sleep_cells", "super_1.0_cells", "noncur_cells", "our_cells")
# Quick ones first, so that a reference is there early.
_METHODS = ("super_1.0", "sleep", *_CELLS, "noncur", "super_0.1", "super_0.05", "our")
_ABLATIONS = ("wake_sleep", "wake_sleep_critic")
_ABLATED = {"circles", "spheres", "varied"}


@dataclass(frozen=True)
class Settings:
    """What to run.

    Attributes:
        only: Worlds; all unless given.
        methods: Rows; all unless given, those of wake and sleep in Circles, Spheres and Varied alone.
        images: Every run's budget; each world's own unless given, with preset paper the paper's.
        seeds: Of the rows in ``SEVERAL_SEEDS``; all else is run with seed 0 alone.
        preset: Of hyperparameters.
        jobs: Runs at once, each with its share of the cores.
        runs: Where run folders lie.
        results: The file of results; tables and plot lie beside it.
        dry_run: Say what would be run, and write the tables of what is there.
    """

    only: tuple[World, ...] = WORLDS
    methods: tuple[str, ...] | None = None
    images: int | None = None
    seeds: tuple[int, ...] = (0, 1, 2)
    preset: Literal["laptop", "paper"] = "laptop"
    jobs: int = min(2, len(os.sched_getaffinity(0)))
    runs: Path = Path("runs/results")
    results: Path = Path("docs/results/worlds.json")
    dry_run: bool = False


def plan(settings: Settings) -> list[QueuedRun]:
    """All runs of the settings: the first seed of every row of every world before the others."""
    for method in settings.methods or ():
        if method not in ORDER:
            raise UsageError(f"--methods {method}: there is no such row, expected some of {', '.join(ORDER)}")
    return [
        _run(settings, world, method, seed)
        for seed in settings.seeds
        for world in settings.only
        for method in settings.methods or _rows_of(world)
        if seed == 0 or method in SEVERAL_SEEDS.get(world, ())
    ]


def _rows_of(world: str) -> tuple[str, ...]:
    rows = (*_METHODS, *_ABLATIONS) if world in _ABLATED else _METHODS
    rows = (*rows, *_HYPOTHESES) if world in _STANDING else rows
    return tuple(row for row in rows if row not in _CELLS or world != "circles")  # one thing alone needs no cells


def _run(settings: Settings, world: str, method: str, seed: int) -> QueuedRun:
    own = BUDGETS[world] if settings.preset == "laptop" else PRESETS["paper"].budget_images
    images = settings.images or own
    name = method.removesuffix("_cells").removesuffix(_FOUND)
    before = None if _FOUND not in method else _run(settings, world, "hypotheses_cells", seed)
    folder = settings.runs / f"{world}-{settings.preset}-{images}" / f"{method.replace('.', '_')}-{seed}"
    learned = ["super", "--labels", name.removeprefix("super_")] if name.startswith("super") else [name]
    others = ["--reading", "cells"] * method.endswith("_cells") + list(_RATES) * bool(before)
    flags = ["--method", *learned, *others, "--preset", settings.preset, "--seed", str(seed)]
    return QueuedRun(f"{world} {method} seed {seed}, {images:,} images", folder, world, images, flags, before=before)


def write(settings: Settings, runs: list[QueuedRun]) -> None:
    """Results, tables and plot of all runs that are done, into what was there."""
    from paper.results_tables import markdown, plot

    found = collect(run.evaluation for run in runs if run.done)
    results = merge(load_results(settings.results), found)
    if results:
        save_results(settings.results, results)
        settings.results.with_suffix(".md").write_text(markdown(results, "make results"), encoding="utf-8")
        plot(results, settings.results.with_suffix(".png"))


def main(settings: Settings) -> int:
    """Carry out what is left."""
    runs = plan(settings)
    write(settings, runs)
    if settings.dry_run:
        for run in runs:
            print(f"{'done' if run.done else 'to do'}: {run.name}: {run.folder}")
        return 0
    return carry_out(runs, settings.jobs, lambda: write(settings, runs))


if __name__ == "__main__":
    chosen = tyro.cli(Settings, description=__doc__)
    sys.exit(answer(lambda _: main(chosen)))
