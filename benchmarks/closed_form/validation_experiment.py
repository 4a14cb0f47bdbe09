"""The paper's validation experiment (main paper, figure "Analytic"; appendix, "Validation Experiment").

    python benchmarks/closed_form/validation_experiment.py [--json] [--seeds 10 11 12] [--figure FILE]

Positions and luminances of 300 discs in 300 images by gradient descent, with the image loss alone and with the oracle
critic beside it. The figure shows the first seed's problems: start, way, end and truth of each.

solved_without   share of the problems that end within 0.05 of the truth, image loss alone, mean over the seeds
solved_with      the same with curiosity
"""

import json
import statistics
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from curio_train.learning.runs.provenance import commit, machine
from discs.validation_experiment import Solution, ValidationSettings, solve

_SETTINGS = ValidationSettings()
_NUM_SEGMENTS = 200  # of a way as it is drawn


def measure(settings: ValidationSettings, seeds: list[int], figure: Path) -> dict[str, Any]:
    """All problems of all seeds, both ways."""
    started = time.monotonic()
    halves = {"without": replace(settings, discrepancy_weight=0.0), "with": settings}
    solutions = {name: [solve(half, seed) for seed in seeds] for name, half in halves.items()}
    draw({name: found[0] for name, found in solutions.items()}, figure)
    shares = {name: [solution.share for solution in found] for name, found in solutions.items()}
    return {
        **{f"solved_{name}": statistics.mean(values) for name, values in shares.items()},
        **{f"solved_{name}_by_seed": values for name, values in shares.items()},
        "seeds": seeds,
        "settings": asdict(settings),
        "seconds": round(time.monotonic() - started, 1),
        "machine": machine(),
        "commit": commit(),
    }


def draw(solutions: Mapping[str, Solution], file: Path) -> None:
    """The position-luminance plane with the ways of all guesses, one panel a half."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, len(solutions), figsize=(6 * len(solutions), 6), sharey=True)
    for panel, (name, solution) in zip(panels, solutions.items(), strict=True):
        path, truth = solution.path.numpy(), solution.truth.numpy()
        stride = max(1, len(path) // _NUM_SEGMENTS)
        for number in range(len(truth)):
            panel.plot(*path[::stride, number].T, color="#8a63c8", alpha=0.25, linewidth=0.5)
            panel.plot(*zip(path[-1, number], truth[number], strict=True), color="0.75", linewidth=0.6)
        panel.scatter(*path[0].T, s=6, color="#4285f4", label="start")
        panel.scatter(*truth.T, s=14, facecolors="none", edgecolors="#ea4335", label="truth")
        panel.scatter(*path[-1].T, s=8, color="black", label="end")
        panel.set(title=f"{name} curiosity: {100 * solution.share:.0f} % solved", xlabel="position t")
    panels[0].set_ylabel("luminance l")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="lower center", ncols=3, frameon=False)
    figure.tight_layout(rect=(0, 0.04, 1, 1))
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=80, pil_kwargs={"optimize": True})


def main(
    json_output: Annotated[bool, tyro.conf.arg(name="json")] = False,
    seeds: tuple[int, ...] = (10, 11, 12),  # not those that the settings were found with
    figure: Path = Path("docs/results/validation_experiment.png"),
    settings: ValidationSettings = _SETTINGS,
) -> None:
    """Run the experiment with both losses, draw it, and say how many problems each solves.

    Args:
        json_output: Print one JSON object instead of two lines.
        seeds: Of truths, starts and samplings; the first is drawn.
        figure: Where the picture goes.
        settings: Of the experiment.
    """
    torch.set_num_threads(1)  # tensors of a few thousand numbers
    result = measure(settings, list(seeds), figure)
    if json_output:
        print(json.dumps(result))
    else:
        print(f"solved without curiosity: {100 * result['solved_without']:.1f} %")
        print(f"solved with curiosity:    {100 * result['solved_with']:.1f} %; drawn in {figure}")


if __name__ == "__main__":
    tyro.cli(main)
