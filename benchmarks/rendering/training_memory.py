"""What training gains, and what it costs, that freed memory is kept (``curio_serve.memory.keep_freed``).

    python benchmarks/rendering/training_memory.py --data DIR [--json]

Steps of a two-stage detector, of the paper's method, and of the locator for several objects, each in a process of its
own, in turns with memory kept and with glibc's own rules.

cpu_ms           CPU time an image, all threads
images_per_s     by the clock: compare the two of a row alone, and only on an idle machine
faults           pages that the system handed out, an image
peak_mib         largest resident memory of the process
"""

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import tyro

WORKLOADS = {
    "two-stage detector": "linemod --class ape --data {data}",
    "chairs, our": "chairs --method our",
    "locator of all objects": "linemod --class all --data {data} --batch-size 32 --micro-batch-size 16",
}
RULES = {"as by default": False, "kept": True}
Figures = dict[str, float]


@dataclass(frozen=True)
class Settings:
    """Measure training with freed memory returned and kept."""

    data: Path
    """LineMOD's or LM-O's meshes, in BOP's layout."""
    steps: int = 6
    """Timed, after as many as the world has stages in turn."""
    rounds: int = 2
    """Of each workload and rule; medians are reported."""
    cache: Path = Path("~/.cache/curio-pose")
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print one JSON object on the last line."""
    child: tuple[str, bool] | None = None
    """A process of this benchmark: its workload and rule."""


def main() -> None:
    """Command line."""
    settings = tyro.cli(Settings, description=__doc__)
    if settings.child is not None:
        print(json.dumps(measured(settings, *settings.child)))
        return
    result: dict[str, object] = {"machine": f"{os.cpu_count()} cores", "rounds": settings.rounds}
    for name in WORKLOADS:
        runs: dict[str, list[Figures]] = {rule: [] for rule in RULES}
        for _ in range(settings.rounds):
            for rule, kept in RULES.items():
                runs[rule].append(in_a_process(settings, name, kept))
        result[name] = {
            rule: {key: round(median(run[key] for run in found), 1) for key in found[0]} for rule, found in runs.items()
        }
        print(name, json.dumps(result[name], indent=1), file=sys.stderr)
    print(json.dumps(result, indent=None if settings.json else 1))


def in_a_process(settings: Settings, name: str, kept: bool) -> Figures:
    """Figures of a new process: what malloc was told cannot be taken back."""
    call = [sys.executable, __file__, "--data", str(settings.data), "--steps", str(settings.steps)]
    call += ["--cache", str(settings.cache), "--child", name, str(kept)]
    done = subprocess.run(call, check=True, capture_output=True, text=True)
    figures: Figures = json.loads(done.stdout.splitlines()[-1])
    return figures


def measured(settings: Settings, name: str, kept: bool) -> Figures:
    """Some steps of training in this process."""
    import resource

    import torch
    from curio_serve.memory import keep_freed
    from curio_train.commands.train import parse
    from curio_train.learning.parallel import Ranks
    from curio_train.learning.trainer import Trainer
    from curio_train.worlds import build
    from curio_train.worlds.base import stages_of

    if kept:
        keep_freed()
    config = parse(WORKLOADS[name].format(data=settings.data).split()).config
    world, cache = build(config.world), settings.cache.expanduser()
    sources = [stage.source("train", 0, with_code=False, cache=cache) for stage in stages_of(world)]
    trainer = Trainer(config, world, sources, Ranks(0, 1, torch.device("cpu")))
    for _ in range(max(3, len(sources))):
        trainer.step(1.0)
    before, clock = resource.getrusage(resource.RUSAGE_SELF), time.perf_counter()
    for _ in range(settings.steps):
        trainer.step(1.0)
    seconds, after = time.perf_counter() - clock, resource.getrusage(resource.RUSAGE_SELF)
    images = settings.steps * config.recipe.batch_size
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {
        "cpu_ms": 1000 * cpu_s / images,
        "images_per_s": images / seconds,
        "faults": (after.ru_minflt - before.ru_minflt) / images,
        "peak_mib": after.ru_maxrss / 1024,
    }


if __name__ == "__main__":
    main()
