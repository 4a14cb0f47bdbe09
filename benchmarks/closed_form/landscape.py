"""Why the image loss alone fails: the landscape of the paper's figure "Concept", for a quad on black.

    python benchmarks/closed_form/landscape.py [--json] [--figure docs/results/landscape.png]

A quad of given place, size and luminance is to be found by gradient descent on the squared image error, in closed form.
Left, over place and luminance: guesses that do not overlap the quad turn black where they stand. Middle, over place and
size: they shrink. Right, as left, with curiosity: 300 such problems at once, and the oracle critic of the validation
experiment, which asks that all guesses together look like draws from the data. Blue ways end wrong, red ones at the
star.

solved_without, solved_with   share of all 300 problems that end within 0.05 of the truth in place and luminance
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from discs.validation_experiment import ValidationSettings, solve
from torch import Tensor

_PLACE, _LUMINANCE, _SIDE = 0.6, 0.8, 0.12
_STARTS = [0.05, 0.2, 0.35, 0.5, 0.7, 0.85]
_NUM_SHOWN = 5  # ways through the landscape with curiosity


def quad_error(place: Tensor, luminance: Tensor, side: Tensor) -> Tensor:
    """Squared difference of the images of a guessed and the true quad, in units of the true quad's area.

    With quads Q of side s, ∫ (l Q − l' Q')² = l² s² + l'² s'² − 2 l l' |Q ∩ Q'|; both stand at the same height.
    """
    left = torch.maximum(place - side / 2, place.new_tensor(_PLACE - _SIDE / 2))
    right = torch.minimum(place + side / 2, place.new_tensor(_PLACE + _SIDE / 2))
    shared = (right - left).clamp(min=0) * side.clamp(max=_SIDE)
    whole = luminance**2 * side**2 + _LUMINANCE**2 * _SIDE**2 - 2 * luminance * _LUMINANCE * shared
    return whole / _SIDE**2


def descend(error: Callable[[Tensor, Tensor], Tensor], start: tuple[float, float], rate: float) -> np.ndarray:
    """The way of gradient descent with ever smaller steps, [num_steps + 1, 2], kept within the picture."""
    point = torch.tensor(start, requires_grad=True)
    way = [point.detach().clone()]
    for step in range(2000):
        (slope,) = torch.autograd.grad(error(point[0], point[1]), point)
        with torch.no_grad():
            point -= rate * (1 - step / 2000) * slope
            point.clamp_(0.0, 1.0)
        way.append(point.detach().clone())
    return torch.stack(way).numpy()


def panel(axes: Any, error: Callable[[Tensor, Tensor], Tensor], truth: tuple[float, float], top: float) -> None:
    """The loss in levels, and the truth as a star."""
    x, y = torch.meshgrid(torch.linspace(0, 1, 300), torch.linspace(0, top, 300), indexing="xy")
    axes.contourf(x, y, error(x, y), levels=30, cmap="Greys_r")
    axes.plot(*truth, marker="*", markersize=16, color="#fbbc04", markeredgecolor="black", zorder=3)
    axes.set(xlabel="place", xlim=(0, 1), ylim=(0, top))


def draw_way(axes: Any, way: np.ndarray, truth: tuple[float, float]) -> None:
    found = np.linalg.norm(way[-1] - truth) < 0.05
    color = "#ea4335" if found else "#4285f4"
    axes.plot(*way.T, color=color, linewidth=1.2)
    axes.plot(*way[0], marker="o", markersize=4, color=color)
    axes.plot(*way[-1], marker="X", markersize=6, color=color)


def draw(file: Path, seed: int) -> dict[str, float]:
    """All three panels; the shares that are solved."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 4.3), layout="constrained")
    by_luminance, by_size, curious = figure.subplots(1, 3)

    def over_luminance(place: Tensor, luminance: Tensor) -> Tensor:
        return quad_error(place, luminance, torch.tensor(_SIDE))

    def over_size(place: Tensor, side: Tensor) -> Tensor:
        return quad_error(place, torch.tensor(_LUMINANCE), side)

    truths = {"luminance": (_PLACE, _LUMINANCE), "size": (_PLACE, _SIDE)}
    panel(by_luminance, over_luminance, truths["luminance"], 1.0)
    panel(by_size, over_size, truths["size"], 0.4)
    for place in _STARTS:
        draw_way(by_luminance, descend(over_luminance, (place, 0.6), 0.002), truths["luminance"])
        draw_way(by_size, descend(over_size, (place, 0.3), 0.0002), truths["size"])
    by_luminance.set(ylabel="luminance", title="image loss: turns black")
    by_size.set(ylabel="size", title="image loss: shrinks")

    settings = ValidationSettings(radius=_SIDE / 2)
    solutions = {weight: solve(ValidationSettings(radius=_SIDE / 2, discrepancy_weight=weight), seed)
                 for weight in (0.0, settings.discrepancy_weight)}  # fmt: skip
    solution = solutions[settings.discrepancy_weight]
    nearest = (solution.truth - torch.tensor(truths["luminance"])).norm(dim=-1).argsort()[:_NUM_SHOWN]
    panel(curious, over_luminance, truths["luminance"], 1.0)
    for number in nearest.tolist():  # of all problems, those whose truth is closest to the star
        draw_way(curious, solution.path[::10, number].numpy(), tuple(solution.truth[number].tolist()))
    curious.set(ylabel="luminance", title="image loss and curiosity")
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=80)
    without, with_ = (solutions[weight].share for weight in sorted(solutions))
    return {"solved_without": without, "solved_with": with_}


def main(
    json_output: Annotated[bool, tyro.conf.arg(name="json")] = False,
    figure: Path = Path("docs/results/landscape.png"),
    seed: int = 10,
) -> None:
    """Draw the landscape and the ways through it.

    Args:
        json_output: Print one JSON object.
        figure: Where the picture goes.
        seed: Of the problems that are solved with curiosity.
    """
    torch.set_num_threads(1)
    result = draw(figure, seed)
    print(json.dumps(result | {"seed": seed}) if json_output else f"drawn in {figure}: {result}")


if __name__ == "__main__":
    tyro.cli(main)
