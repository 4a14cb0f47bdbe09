"""Can anything stand in for curiosity? The paper says that no weight, learning rate, randomisation or patience can.

    python benchmarks/curiosity.py [--world chairs] [--reading cells] [--images 16000] [--only noncur]

Runs of image loss alone with each of these changed, beside the paper's method with batch and with instance norm in the
critic, without the critic's gradient penalty, with learning rates that stay as they are, and full supervision, in one
world. By default that is Chairs, read by the dense decoder: there image loss alone stays where it is, and the paper's
method does not. Each run is trained and scored in a folder of its own under ``runs/curiosity``; after each, the world's
part of docs/results/curiosity.json and curiosity.md is written anew. Stop it at any time: the same command goes on
where it stopped.

para, img   Eq. 1 and DSSIM from the novel view
"""

import json
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro
from curio_train.commands.command_line.running import answer
from curio_train.config import PRESETS
from curio_train.errors import UsageError
from paper.run_queue import QueuedRun, carry_out

_RECIPE = PRESETS["laptop"]
_LONGER = 4


def _changed(name: str, value: float, factor: float) -> Sequence[str]:
    return ("--method", "noncur", f"--{name}", f"{value * factor:g}")


VARIANTS: Mapping[str, Sequence[str]] = {
    "super": ("--method", "super"),
    "our": ("--method", "our"),
    "our, instance norm": ("--method", "our", "--critic-normalisation", "instance"),
    "our, no gradient penalty": ("--method", "our", "--gradient-penalty", "0"),
    "our, constant learning rates": ("--method", "our", "--warm-up-steps", "0", "--final-learning-rate", "1"),
    "noncur": ("--method", "noncur"),
    "noncur, image weight / 10": _changed("image-weight", _RECIPE.image_weight, 0.1),
    "noncur, image weight x 10": _changed("image-weight", _RECIPE.image_weight, 10),
    "noncur, learning rate / 4": _changed("learning-rate", _RECIPE.learning_rate, 0.25),
    "noncur, learning rate x 4": _changed("learning-rate", _RECIPE.learning_rate, 4),
    "noncur, other start": ("--method", "noncur", "--seed", "1"),
    "noncur, small batches": ("--method", "noncur", "--batch-size", "16", "--micro-batch-size", "16"),
    "noncur, longer": ("--method", "noncur"),
}
"""Flags by what is changed; small batches are the randomisation of every step, another start is that of the whole."""


@dataclass(frozen=True)
class Settings:
    """What to run.

    Attributes:
        world: In which.
        reading: Of the network; "whole" is the paper's.
        images: Of every run; "longer" sees four times as many.
        only: Variants by name; all unless given.
        jobs: Runs at once, each with its share of the cores.
        runs: Where run folders lie.
        results: The file of results, by world; the tables lie beside it.
    """

    world: Literal["circles", "spheres", "chairs", "varied", "multi", "light"] = "chairs"
    reading: Literal["whole", "cells"] = "cells"
    images: int = 16_000
    only: tuple[str, ...] = tuple(VARIANTS)
    jobs: int = min(2, len(os.sched_getaffinity(0)))
    runs: Path = Path("runs/curiosity")
    results: Path = Path("docs/results/curiosity.json")


def plan(settings: Settings) -> list[QueuedRun]:
    """A run a variant."""
    if unknown := [name for name in settings.only if name not in VARIANTS]:
        raise UsageError(f"--only {unknown[0]!r}: there is no such variant, expected some of {list(VARIANTS)}")
    runs = []
    for name in settings.only:
        images = settings.images * (_LONGER if name.endswith("longer") else 1)
        slug = name.replace(", ", "-").replace(" / ", "-by-").replace(" x ", "-times-").replace(" ", "-")
        folder = settings.runs / f"{settings.world}-{settings.reading}-{settings.images}" / slug
        flags = (*VARIANTS[name], "--reading", settings.reading)
        runs.append(QueuedRun(name, folder, settings.world, images, flags))
    return runs


def write(settings: Settings, runs: list[QueuedRun]) -> None:
    """Results and table of the runs that are done, beside those of other worlds."""
    rows = {run.name: _row(run) for run in runs if run.done}
    if not rows:
        return
    results = json.loads(settings.results.read_text(encoding="utf-8")) if settings.results.exists() else {}
    title = settings.world + (", read by the dense decoder" if settings.reading == "cells" else "")
    found = results.get(title, {}) | rows
    results[title] = {name: found[name] for name in VARIANTS if name in found}
    settings.results.parent.mkdir(parents=True, exist_ok=True)
    settings.results.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    settings.results.with_suffix(".md").write_text(_markdown(results), encoding="utf-8")


def _markdown(results: Mapping[str, Mapping[str, Any]]) -> str:
    lines = ["# In place of curiosity", "", "Written by `python benchmarks/curiosity.py`; one seed each."]
    for title, rows in results.items():
        lines += ["", f"## {title.capitalize()}", ""]
        lines += ["| run | Para | Img | images seen | minutes |", "| --- | --- | --- | --- | --- |"]
        lines += [
            f"| {name} | {row['para']:.3g} | {row['img']:.3g} | {row['images_seen']:,} | {row['seconds'] / 60:.1f} |"
            for name, row in rows.items()
        ]
    return "\n".join(lines) + "\n"


def _row(run: QueuedRun) -> dict[str, Any]:
    found = run.evaluation
    return {
        "para": found["metrics"]["scene_error"],
        "img": found["metrics"]["novel_view_dssim"],
        "flags": list(run.flags),
        "images_seen": found["images_seen"],
        "seconds": found["training_seconds"],
        "machine": found["machine"],
        "commit": found["commit"],
    }


def main(settings: Settings) -> int:
    """Carry out what is left."""
    runs = plan(settings)
    write(settings, runs)
    return carry_out(runs, settings.jobs, lambda: write(settings, runs))


if __name__ == "__main__":
    chosen = tyro.cli(Settings, description=__doc__)
    sys.exit(answer(lambda _: main(chosen)))
