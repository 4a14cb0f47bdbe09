"""What curiosity does while a network learns: the error over images seen, with image loss alone and with the critic.

    python benchmarks/paper/over_images.py [--world chairs] [--images 16000] [--seeds 0 1 2] [--jobs 2] [--results FILE]

Both methods learn a world with the dense decoder, once a seed, each run with the learning rates of a run of so many
images. At marks, each twice as many images as the one before, the network reads 200 images of the validation split.
Written at the end: docs/results/over_images.json (by world: the errors by method and seed), and a picture of the
world beside it: the curves above, below them a test image and what each method makes of it at the marks (first seed).

yaw_deg, position_m   mean error at each mark
"""

import json
import multiprocessing
import os
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from curio_train.commands.command_line.running import CACHE
from curio_train.config import NetworkConfig, RunConfig
from curio_train.learning.loop import learning_rate_factor
from curio_train.learning.parallel import Ranks
from curio_train.learning.runs.provenance import commit, machine
from curio_train.learning.trainer import Trainer
from curio_train.metrics.assignment import parameter_errors
from curio_train.worlds import WORLDS, build
from curio_train.worlds.base import World
from curio_train.worlds.image_sets import StoredImages
from matplotlib.figure import Figure

Method = Literal["noncur", "our"]
_METHODS: Sequence[Method] = ("noncur", "our")
_COLORS = {"noncur": "tab:orange", "our": "tab:blue"}
_FIRST_MARK = 1000  # images
_NUM_SCORED = 200


@dataclass(frozen=True)
class Settings:
    """What to run.

    Attributes:
        world: One whose objects stand on the ground, or spheres.
        images: Of every run.
        seeds: Of weights and order.
        jobs: Runs at once, each on one core.
        results: The file of results, by world; pictures lie beside it.
    """

    world: Literal["spheres", "chairs", "varied", "multi", "light"] = "chairs"
    images: int = 16_000
    seeds: tuple[int, ...] = (0, 1, 2)
    jobs: int = min(2, len(os.sched_getaffinity(0)))
    results: Path = Path("docs/results/over_images.json")


class Learner:
    """One run and what its network makes of held-out images."""

    def __init__(self, settings: Settings, method: Method, seed: int) -> None:
        """Build it."""
        options = WORLDS[settings.world]()
        network = NetworkConfig(reading="cells")
        self._config = RunConfig(options, method=method, seed=seed, images=settings.images, network=network)
        self.world: World = build(options)
        source = self.world.source("train", seed, with_code=False, cache=CACHE)
        self._trainer = Trainer(self._config, self.world, [source], Ranks(0, 1, torch.device("cpu")))
        held_out = self.world.source("validation", 0, with_code=True, cache=CACHE)
        assert isinstance(held_out, StoredImages)
        self._held_out = held_out.subset(_NUM_SCORED / len(held_out))

    def learn(self, images: int) -> None:
        """Train until so many images are seen."""
        progress = self._trainer.state.progress
        while progress.images < images:
            spent = self._config.progress(progress.images, 0.0)
            self._trainer.step(learning_rate_factor(self._config.recipe, progress.step, spent))

    @torch.no_grad()
    def errors(self) -> dict[str, float]:
        """On the held-out images."""
        code, images = self._held_out.code, self._held_out.images.float() / 255
        assert code is not None
        groups = [kind.slots for kind in self.world.objects]
        found = parameter_errors(self.world.layout, self._read(images), code, groups)
        names = {"position": "position_m", "rotation_deg": "yaw_deg"}
        return {names[name]: round(value, 4) for name, value in found.items() if name in names}

    @torch.no_grad()
    def picture(self) -> np.ndarray:
        """What the network makes of the first held-out image, [height, width, 3]."""
        return shown(self.world.render(self._read(self._held_out.images[:1].float() / 255))[0])

    @property
    def image(self) -> np.ndarray:
        """That image."""
        return shown(self._held_out.images[0].float() / 255)

    def _read(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
        network = self._trainer.state.pose.network.eval()
        code: dict[str, torch.Tensor] = network(images)
        network.train()
        return code


def shown(image: torch.Tensor) -> np.ndarray:
    """An image [3, height, width] as matplotlib takes it."""
    return image.clamp(0, 1).movedim(0, -1).numpy()


def marks_of(images: int) -> list[int]:
    """The marks of a run of so many images; the last is its end."""
    marks = [_FIRST_MARK]
    while 2 * marks[-1] < images:
        marks.append(2 * marks[-1])
    return [*marks, images]


def draw(
    errors: Mapping[Method, Sequence[Mapping[str, Sequence[float]]]],
    marks: Sequence[int],
    rows: Mapping[Method, Sequence[np.ndarray]],
    file: Path,
) -> None:
    """Curves of all runs, and below them the pictures of the first seed."""
    figure = Figure(figsize=(1.5 * (len(marks) + 1), 7.5), layout="constrained")
    halves = figure.add_gridspec(2, 1)
    above, below = (figure.add_subfigure(halves[n]) for n in range(2))
    panel = above.subplots()
    name = "yaw_deg" if "yaw_deg" in errors[_METHODS[0]][0] else "position_m"
    for method, runs in errors.items():
        for number, run in enumerate(runs):
            panel.plot(marks, run[name], color=_COLORS[method], marker="o", label=method if number == 0 else None)
    panel.set(xscale="log", xlabel="images seen", ylabel="yaw error, degrees" if name == "yaw_deg" else "error, metres")
    panel.set_xticks(marks, [f"{mark:,}" for mark in marks])
    panel.minorticks_off()
    panel.set_ylim(0, 1.05 * max(max(run[name]) for runs in errors.values() for run in runs))
    panel.legend(frameon=False)
    grid = below.subplots(len(rows), len(marks) + 1, squeeze=False)
    for (method, pictures), axes in zip(rows.items(), grid, strict=True):
        titles = [method, *(f"{mark:,}" for mark in marks)]
        for axis, picture, title in zip(axes, pictures, titles, strict=True):
            axis.imshow(picture)
            axis.set_title(title, fontsize=8)
            axis.set_axis_off()
    figure.savefig(file, dpi=70)


def learned(settings: Settings, method: Method, seed: int) -> tuple[dict[str, list[float]], list[np.ndarray]]:
    """One run: its errors at the marks, and the image with what became of it there."""
    torch.set_num_threads(1)  # small networks
    learner, found = Learner(settings, method, seed), list[dict[str, float]]()
    pictures = [learner.image]
    for mark in marks_of(settings.images):
        learner.learn(mark)
        found.append(learner.errors())
        pictures.append(learner.picture())
        print(f"{settings.world}, {method}, seed {seed}, {mark:,} images: {found[-1]}", flush=True)
    return {name: [one[name] for one in found] for name in found[0]}, pictures


def main(settings: Settings) -> None:
    """Run both methods with every seed."""
    begun, marks = time.monotonic(), marks_of(settings.images)
    with ProcessPoolExecutor(settings.jobs, multiprocessing.get_context("spawn")) as processes:
        runs = {
            method: [processes.submit(learned, settings, method, seed) for seed in settings.seeds]
            for method in reversed(_METHODS)  # the critic takes longer
        }
        done = {method: [run.result() for run in runs[method]] for method in _METHODS}
    errors = {method: [found for found, _ in results] for method, results in done.items()}
    made: dict[str, Any] = {"marks": marks, "seeds": list(settings.seeds), "minutes": (time.monotonic() - begun) / 60}
    results = json.loads(settings.results.read_text(encoding="utf-8")) if settings.results.exists() else {}
    results[settings.world] = errors | made | {"machine": machine(), "commit": commit()}
    settings.results.parent.mkdir(parents=True, exist_ok=True)
    settings.results.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    pictures = {method: results[0][1] for method, results in done.items()}
    draw(errors, marks, pictures, settings.results.with_name(f"over_images-{settings.world}.png"))


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
