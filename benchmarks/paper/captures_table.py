"""The paper's Table 4 for captures: image errors from a second camera, with the paper's figures beside ours."""

from collections.abc import Mapping, Sequence
from typing import Any

from paper.results import markdown_table

PAPER: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "sphere_real": {"noncur": (0.48, 0.41), "our": (0.33, 0.25)},
    "bunny": {"noncur": (0.46, 0.43), "our": (0.36, 0.31)},
    "shapes": {"noncur": (0.54, 0.46), "our": (0.37, 0.29)},
}
"""DSSIM sharp and blurred (paper, section "Real world data")."""
METHODS: Sequence[str] = ("noncur", "our", "sleep", "sleep_cells")

Row = dict[str, Any]
Table = dict[str, dict[str, Row]]


def row(evaluation: Mapping[str, Any]) -> Row:
    """A cell of the table from what ``curio-eval`` found."""
    metrics = evaluation["photographs"]["metrics"]
    return {
        "sharp": metrics["second_view_dssim"],
        "blurred": metrics["second_view_dssim_blurred"],
        "plate": [metrics["second_view_plate_dssim"], metrics["second_view_plate_dssim_blurred"]],
        "own_view": [metrics["own_view_dssim"], metrics["own_view_dssim_blurred"]],
        "better_than_plate": metrics["better_than_plate"],
        "num_photographs": evaluation["photographs"]["num_photographs"],
        "images_seen": evaluation["images_seen"],
        "seconds": evaluation["training_seconds"],
        "seed": evaluation["seed"],
        "machine": evaluation["machine"],
        "commit": evaluation["commit"],
        "synthetic_labels": evaluation["labels_synthetic"],
    }


def markdown(table: Table, command: str) -> str:
    """The table, what it is measured against, and how it was made."""
    parts = [
        "# Captures: learned from photographs, judged from a second camera",
        f"Written by `{command}` from [captures.json](captures.json). DSSIM between the second camera's photograph and"
        " what was read in the first camera's, drawn from there over its background image; *blurred*: both behind a 9x9"
        " Gaussian filter. Smaller is better. Photographs are synthetic captures ([recipe](../recipes/capture.md)), so"
        " the paper's figures, in brackets, are of other photographs: only the order of methods compares. `sleep` and"
        " `sleep_cells` go beyond the paper: they learn from renderings of codes that the world draws itself, synthetic"
        " labels in the sense of the paper's LineMOD table; the latter with another network, which reads images cell by"
        " cell (`--reading cells`, usual on a plane). Nobody labels anything in any row.",
        _errors(table),
        "*Empty background image*: the error of finding nothing at all.",
        "## How they were made",
        _provenance(table),
    ]
    return "\n\n".join(parts) + "\n"


def _errors(table: Table) -> str:
    headings = ["method", *(f"{scene}, {kind}" for scene in table for kind in ("sharp", "blurred"))]
    lines = []
    for method in (name for name in METHODS if any(name in rows for rows in table.values())):
        cells = [f"`{method}`"]
        for scene, rows in table.items():
            theirs = PAPER[scene].get(method)
            for place, kind in enumerate(("sharp", "blurred")):
                beside = "" if theirs is None else f" ({theirs[place]:.2f})"
                cells.append(f"{rows[method][kind]:.4f}{beside}" if method in rows else "–")
        lines.append(cells)
    backgrounds = [next(iter(rows.values()))["plate"] for rows in table.values()]
    lines.append(["empty background image", *(f"{value:.4f}" for plate in backgrounds for value in plate)])
    return markdown_table(headings, lines)


def _provenance(table: Table) -> str:
    headings = [
        "scene",
        "method",
        "nearer than the background image",
        "own view",
        "images seen",
        "seed",
        "minutes",
        "machine",
    ]
    lines = [
        [
            scene,
            f"`{method}`",
            f"{row['better_than_plate']:.0%} of {row['num_photographs']}",
            f"{row['own_view'][0]:.4f} / {row['own_view'][1]:.4f}",
            f"{row['images_seen']:,}",
            str(row["seed"]),
            f"{row['seconds'] / 60:.1f}",
            row["machine"],
            row["commit"][:7],
        ]
        for scene, rows in table.items()
        for method, row in rows.items()
    ]
    return markdown_table([*headings, "commit"], lines)
