"""The pictures of a report, each as a data URI that an ``<img>`` can hold."""

import base64
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from curio_train.learning.runs.progress import IMAGE_ERROR

_DPI = 90
_PANELS_A_ROW = 3
HEADINGS = ("input", "prediction", "novel view")
_NOT_LOSSES = ("step", "images", "seconds", IMAGE_ERROR)


def samples(columns: Sequence[Tensor], headings: Sequence[str] = HEADINGS, captions: Sequence[str] = ()) -> str:
    """A grid with a row an image, such as input, re-rendering, the predicted scene from the novel view.

    Args:
        columns: Each [num, 3, height, width] in [0, 1].
        headings: One a column.
        captions: One a row, written to its left, or none.
    """
    num = len(columns[0])
    figure = Figure(figsize=(max(6, 2 * len(columns)), 2 * num), layout="constrained")
    panels = figure.subplots(num, len(columns), squeeze=False)
    for number, (heading, column) in enumerate(zip(headings, columns, strict=True)):
        panels[0, number].set_title(heading)
        for panel, image in zip(panels[:, number], column, strict=True):
            panel.imshow(image.permute(1, 2, 0).cpu().numpy(), interpolation="nearest")
            panel.set_axis_off()
    for panel, caption in zip(panels[:, 0], captions, strict=False):
        panel.text(-0.05, 0.5, caption, transform=panel.transAxes, ha="right", va="center")
    return _uri(figure)


def curves(rows: Sequence[Mapping[str, Any]]) -> str:
    """Each loss over the images seen.

    Args:
        rows: Of ``history.jsonl``; may be none, of a run too short for a line.
    """
    names = sorted({name for row in rows for name in row} - {*_NOT_LOSSES})
    figure, panels = _panels(max(1, len(names)))
    for panel, name in zip(panels, names, strict=False):
        seen = [(row["images"], row[name]) for row in rows if name in row]
        panel.plot(*np.array(seen).T, color="#4285f4", linewidth=1.2, marker="." if len(seen) < 3 else None)
        panel.set(title=f"loss: {name}", xlabel="images seen")
        if min(value for _, value in seen) > 0:
            panel.set_yscale("log")
    if not names:
        panels[0].text(0.5, 0.5, "too few steps for a curve", ha="center", va="center")
        panels[0].set_axis_off()
    return _uri(figure)


def error_over_time(rows: Sequence[Mapping[str, Any]]) -> str | None:
    """The image error of re-renderings over the minutes of training; None if fewer than two were noted.

    Args:
        rows: Of ``history.jsonl``.
    """
    noted = [(row["seconds"] / 60, row[IMAGE_ERROR]) for row in rows if IMAGE_ERROR in row]
    if len(noted) < 2:
        return None
    figure, (panel,) = _panels(1)
    panel.plot(*np.array(noted).T, color="#ea4335", linewidth=1.2, marker=".")
    panel.set(xlabel="minutes of training", ylabel="image error (DSSIM)", ylim=(0, None), xlim=(0, None))
    return _uri(figure)


def reliability(sets: Mapping[str, Sequence[Mapping[str, float]]]) -> str:
    """How often poses of each confidence are correct: on the diagonal, confidence is a probability.

    Args:
        sets: Bins of :func:`~curio_train.metrics.calibration.reliability_bins` by what was scored.
    """
    figure, panels = _panels(len(sets))
    for panel, (name, bins) in zip(panels, sets.items(), strict=True):
        panel.plot([0, 1], [0, 1], color="black", linestyle="--", linewidth=1)
        width = [bin_["to"] - bin_["from"] for bin_ in bins]
        panel.bar([b["from"] for b in bins], [b["correct"] for b in bins], width, align="edge", color="#4285f4")
        for bin_ in bins:
            panel.text((bin_["from"] + bin_["to"]) / 2, 0.01, bin_["count"], ha="center", va="bottom", fontsize=7)
        panel.set(title=name, xlabel="confidence", ylabel="fraction correct", xlim=(0, 1), ylim=(0, 1))
    return _uri(figure)


def histograms(errors: Mapping[str, Tensor]) -> str:
    """Histograms of the errors; dashed lines are medians."""
    figure, panels = _panels(len(errors))
    for panel, (name, values) in zip(panels, errors.items(), strict=True):
        found = values.detach().double().flatten().cpu().numpy()
        found = found[np.isfinite(found)]
        panel.set(title=name.strip(), ylabel="count")
        if not len(found):
            continue
        panel.hist(found, bins=40, range=(min(0.0, found.min()), max(np.quantile(found, 0.99), 1e-9)), color="#34a853")
        panel.axvline(float(np.median(found)), color="black", linestyle="--", linewidth=1)
    return _uri(figure)


def _panels(count: int) -> tuple[Figure, list[Any]]:
    """A figure with that many axes, the rest of its grid empty."""
    across = min(count, _PANELS_A_ROW)
    down = -(-count // across)
    figure = Figure(figsize=(4 * across, 2.6 * down), layout="constrained")
    axes = figure.subplots(down, across, squeeze=False).ravel().tolist()
    for spare in axes[count:]:
        spare.set_axis_off()
    return figure, axes[:count]


def _uri(figure: Figure) -> str:
    """Encode a figure as a PNG data URI; matplotlib's Figure class needs no window and no global state."""
    png = io.BytesIO()
    figure.savefig(png, format="png", dpi=_DPI)
    return uri(png.getvalue())


def uri(png: bytes) -> str:
    """The data URI of a PNG file."""
    return "data:image/png;base64," + base64.b64encode(png).decode()
