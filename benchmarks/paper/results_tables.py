"""The paper's Tables 2 and 3 from results, with the paper's figures beside ours, and a plot."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from paper import paper_tables as paper
from paper.results import ORDER, REFERENCE, WORLDS, Results, Row, markdown_table

_TITLES: Mapping[str, str] = {
    "position": "Position",
    "color_mse": "Colour, squared error",
    "rotation_deg": "Rotation, degrees",
    "confidence_mse": "Confidence, squared error",
    "light_deg": "Light direction, degrees",
}
_COLOURS: Mapping[str, str] = {
    "super_0.05": "#4285f4",
    "super_0.1": "#ea4335",
    "noncur": "#fbbc04",
    "our": "#34a853",
    "wake_sleep_critic": "#46bdc6",
    "wake_sleep": "#ff6d01",
    "sleep": "#8a63c8",
    "super_1.0_cells": "#9aa0a6",
    "noncur_cells": "#b98900",
    "our_cells": "#1e6b35",
    "hypotheses_cells": "#1f6f8b",
    "our_found_cells": "#0b3d91",
    "sleep_cells": "#5f3b9e",
}
_CELLS = "_cells"
_UNLABELLED = (
    "noncur",
    "our",
    "sleep",
    "noncur_cells",
    "our_cells",
    "hypotheses_cells",
    "our_found_cells",
    "sleep_cells",
)
_NOTHING = "–"
Figures = Mapping[str, Sequence[float]]


def markdown(results: Results, command: str) -> str:
    """Both tables, the absolute figures behind them, and how they were made."""
    methods = [name for name in ORDER if any(name in rows for rows in results.values())]
    others = [name for name in methods if name != REFERENCE]
    parts = [
        "# Every world and method",
        f"Written by `{command}` from [worlds.json](worlds.json). Ratios to `{REFERENCE}`, the same network with all"
        " true codes and as many images; the paper's stand in brackets. *Img* is DSSIM from a novel view, *Para* is"
        " Eq. 1. `sleep`, `wake_sleep` and `wake_sleep_critic` go beyond the paper: they learn from renderings of codes"
        " drawn from the world's known range, synthetic labels in the sense of the paper's LineMOD table. Rows of"
        " `…_cells` have another network, which reads images cell by cell (`--reading cells`): full supervision, image"
        " loss alone, the paper's loss, hypotheses (image loss minimised over rendered hypotheses of each image before"
        " training), the paper's loss begun as a run of those (so it has seen twice as many images), and sleep.",
        "![Ratios by world](worlds.png)",
        "## Table 2: Img",
        _ratios(results, others, lambda row: row["img_ratio"], paper.IMG),
        "## Table 2: Para",
        _ratios(results, others, lambda row: row["para_ratio"], paper.PARA),
        "## Para, against supervision of the same network",
        f"Ratios of `…_cells` to `{REFERENCE}_cells`, and of the paper's network to `{REFERENCE}`: how much is lost"
        " without labels, whatever the network.",
        _ratios(_against_own_network(results), _UNLABELLED, lambda row: row["own_ratio"], paper.PARA),
        "## Table 3: each parameter",
    ]
    for name, title in _TITLES.items():
        known = {world: rows for world, rows in results.items() if any(_parameter(row, name) for row in rows.values())}
        if known:
            parts += [f"### {title}", _ratios(known, others, _reader(name), paper.PARAMETERS[name])]
    parts += ["## Absolute figures", _absolute(results), "## How they were made", _making(results)]
    return "\n\n".join(parts) + "\n"


def plot(results: Results, file: Path) -> None:
    """Both ratios of Table 2 by world; ours filled, the paper's hollow, full supervision the line at 1."""
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    for panel, (name, figures) in zip(figure.subplots(1, 2), (("img", paper.IMG), ("para", paper.PARA)), strict=True):
        for number, (method, colour) in enumerate(_COLOURS.items()):
            shift = (number - (len(_COLOURS) - 1) / 2) * 0.07
            found = [(WORLDS.index(w) + shift, row[f"{name}_ratio"]) for w, row in _rows(results, method)]
            found = [(place, value) for place, value in found if value]
            panel.scatter(*zip(*found, strict=True) if found else ([], []), s=34, color=colour, label=method)
            if method in paper.METHODS:
                printed = [figures[world][paper.METHODS.index(method)] for world in WORLDS]
                places = [n + shift for n in range(len(WORLDS))]
                panel.scatter(places, printed, s=34, facecolors="none", edgecolors=colour)
        panel.axhline(1, color="black", linewidth=2)
        panel.set(yscale="log", title=f"{name.capitalize()}: ratio to full supervision")
        panel.set_xticks(range(len(WORLDS)), WORLDS)
    handles, labels = panel.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    figure.savefig(file, dpi=80)


def _rows(results: Results, method: str) -> list[tuple[str, Row]]:
    return [(world, rows[method]) for world, rows in results.items() if method in rows]


def _ratios(results: Results, methods: Sequence[str], read: Callable[[Row], float | None], printed: Figures) -> str:
    """A row a world, a column a method: ours (the paper's)."""
    if not methods:
        return "Nothing to compare with the reference yet."
    lines = []
    for world, rows in results.items():
        cells = [_cell(read(rows[method]) if method in rows else None) for method in methods]
        theirs = dict(zip(paper.METHODS, printed.get(world, ()), strict=False))
        beside = [f" ({theirs[method]:g})" if method in theirs else "" for method in methods]
        lines.append([world, *(cell + text for cell, text in zip(cells, beside, strict=True))])
    return markdown_table(["world", *(f"`{method}`" for method in methods)], lines)


def _absolute(results: Results) -> str:
    """The errors themselves, of every method: a ratio to a bad reference is worth nothing."""
    lines = []
    for world, rows in results.items():
        for method, row in rows.items():
            parameters = {"position" if name.startswith("position") else name: v for name, v in _parts(row)}
            unit = "" if "position_m" in row["per_parameter"] else " widths"
            cells = [_cell(parameters.get(name)) for name in _TITLES]
            cells[0] += unit or " m"
            lines.append([world, f"`{method}`", _cell(row["img"]), _cell(row["para"]), *cells])
    return markdown_table(["world", "method", "Img", "Para", *_TITLES.values()], lines)


def _making(results: Results) -> str:
    lines = [
        [
            world,
            f"`{method}`",
            f"{row['images_seen']:,}",
            ", ".join(map(str, row["seeds"])),
            _spread(row["by_seed"]["para"]),
            f"{row['seconds'] / 60:.1f}",
            "yes" if row["label_free"] else "no",
            "yes" if row["synthetic_labels"] else "no",
            row["machine"],
            row["commit"][:7],
        ]
        for world, rows in results.items()
        for method, row in rows.items()
    ]
    headings = ["world", "method", "images seen", "seeds", "Para from – to", "minutes a run"]
    return markdown_table([*headings, "label-free", "synthetic labels", "machine", "commit"], lines)


def _spread(values: Sequence[float]) -> str:
    return f"{min(values):.3g} – {max(values):.3g}" if len(values) > 1 else _NOTHING


def _parts(row: Row) -> list[tuple[str, float]]:
    return list(row["per_parameter"].items())


def _parameter(row: Row, name: str) -> bool:
    return any(key.startswith(name) for key in row["per_parameter"])


def _reader(name: str) -> Callable[[Row], float | None]:
    """The ratio of the parameter of that name, whatever its unit."""
    return lambda row: next((v for key, v in row["per_parameter_ratio"].items() if key.startswith(name)), None)


def _against_own_network(results: Results) -> Results:
    """The rows with Eq. 1 divided by that of full supervision of the same network; None where that is missing."""
    found: Results = {}
    for world, rows in results.items():
        found[world] = {}
        for method, row in rows.items():
            reference = rows.get(REFERENCE + (_CELLS if method.endswith(_CELLS) else ""))
            found[world][method] = row | {"own_ratio": row["para"] / reference["para"] if reference else None}
    return found


def _cell(value: float | None) -> str:
    return _NOTHING if value is None else f"{value:.3g}"
