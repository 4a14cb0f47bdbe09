"""LineMOD results as a page: our rows by class, a published method's beside them, and the paper's table."""

from collections.abc import Mapping, Sequence
from statistics import mean

from curio_train.data.bop import LINEMOD_CLASSES

from paper.paper_tables import LINEMOD
from paper.results import Results, Row, markdown_table

PUBLISHED: Mapping[str, tuple[float, float, int]] = {
    "ape": (46.1, 65.5, 58),
    "can": (61.6, 74.2, 62),
    "cat": (37.5, 51.9, 52),
    "driller": (59.0, 85.2, 54),
    "duck": (42.4, 53.8, 65),
    "eggbox": (16.7, 31.2, 16),
    "glue": (52.2, 75.0, 56),
    "holepuncher": (20.0, 18.9, 90),
}
"""A published RGB method, trained with labels, on 100 frames of Linemod-Occluded.

ADD(-S) below a tenth of the diameter, per cent: of all targets, of those at least 80 % visible, and how many those are.
"""

_NOTHING = "–"
_VISIBLE = "add_recall_visible_80"
_HEAD = ("class", "images seen", "minutes", "ADD(-S)", "rotation", "position", "ECE", "AUROC")
_REAL = ("all targets", "n", "published", "≥ 80 % visible", "n", "published", "rotation", "position")


def markdown(table: Results, command: str) -> str:
    """The page.

    Args:
        table: From :mod:`~paper.linemod_table`.
        command: That writes it.
    """
    parts = [
        "# LineMOD",
        f"Written by `{command}` from [linemod.json](linemod.json). A row is one network. On held-out renderings, "
        "whole frames over unseen backgrounds: share of poses with ADD(-S) below a tenth of the diameter in per cent, "
        "medians of rotation (degrees) and position (mm), calibration error of the confidence, and how well it tells "
        "frames with the object from frames without. On real frames, RGB and K alone: the same share with a 95 % "
        "bootstrap interval. *Published* is an RGB method trained with labels, given where these are the frames that "
        "its estimates are known for. *Refined* poses are what the network answers after render-and-compare "
        "(`curio-eval --refine`), which needs the mesh and the renderer and is no part of serving. *Self-trained* "
        "networks have learned from unlabelled real frames, too. Of *templates* a trained locator finds the object, "
        "and templates that were drawn before tell its pose; other networks regress it. Images and minutes count those "
        "of the networks that one began as (`--init`).",
    ]
    for method, rows in table.items():
        parts += [f"## `{method}`", _supervision(rows), _rows(rows)]
        if single := _frames(rows):
            parts += ["Single frames:", single]
    return "\n\n".join([*parts, "## The paper's table", _paper(table)]) + "\n"


def _supervision(rows: Mapping[str, Row]) -> str:
    kinds = {(row["labels_real"], row["labels_synthetic"]) for row in rows.values()}
    real, synthetic = (any(kind[i] for kind in kinds) for i in (0, 1))
    sets = sorted({f"{row['real']['dataset']}, {row['real']['split_name']}" for row in rows.values()})
    counts = " or ".join(f"{count:,}" for count in sorted({row["num_images"] for row in rows.values()}))
    return (
        f"Labels of real images: {_yes(real)}; of renderings: {_yes(synthetic)}. {counts} renderings a class. "
        f"Real frames: {'; '.join(sets)}. "
        f"{', '.join(sorted({row['machine'] for row in rows.values()}))}."
    )


def _yes(value: bool) -> str:
    return "yes" if value else "no"


def _rows(rows: Mapping[str, Row]) -> str:
    lines = [[name, *_cells(name, rows[name])] for name in LINEMOD_CLASSES if name in rows]
    lines.append(
        [f"**mean of {len(lines)}**", *_means([(name, rows[name]) for name in LINEMOD_CLASSES if name in rows])]
    )
    return markdown_table((*_HEAD, *(f"real: {name}" for name in _REAL)), lines)


def _cells(name: str, row: Row) -> list[str]:
    rendered, real = row["rendered"], row["real"]
    metrics = real["metrics"]
    every, seen = _published(name, row) or (None, None)
    return [
        f"{row['images_seen']:,}",
        f"{row['training_seconds'] / 60:.0f}",
        _percent(rendered["add_recall"]),
        f"{rendered['rotation_deg_median']:.1f}",
        f"{rendered['translation_mm_median']:.1f}",
        _number(rendered.get("confidence_ece"), 3),
        _number(rendered.get("present_auroc"), 3),
        _interval(metrics, "add_recall"),
        str(real["num_targets"]),
        _number(every, 1),
        _interval(metrics, _VISIBLE),
        str(real["num_targets_visible_80"]),
        _number(seen, 1),
        f"{metrics['rotation_deg_median']:.1f}",
        f"{metrics['translation_mm_median']:.1f}",
    ]


def _means(rows: Sequence[tuple[str, Row]]) -> list[str]:
    """Of the shares alone; published ones where all classes have them."""
    published = [_published(name, row) for name, row in rows]
    known = [pair for pair in published if pair]
    every, seen = (mean(pair[i] for pair in known) if len(known) == len(rows) else None for i in (0, 1))
    metrics = [row["real"]["metrics"] for _, row in rows]
    visible = [found[_VISIBLE] for found in metrics if _VISIBLE in found]
    rendered = _percent(mean(row["rendered"]["add_recall"] for _, row in rows))
    calibration = [_mean_of(rows, name) for name in ("confidence_ece", "present_auroc")]
    real = [_percent(mean(found["add_recall"] for found in metrics)), "", _number(every, 1)]
    return [
        "",
        "",
        rendered,
        "",
        "",
        *calibration,
        *real,
        _percent(mean(visible)) if visible else _NOTHING,
        "",
        _number(seen, 1),
        "",
        "",
    ]


def _mean_of(rows: Sequence[tuple[str, Row]], name: str) -> str:
    values = [row["rendered"][name] for _, row in rows if name in row["rendered"]]
    return _number(mean(values), 3) if values else _NOTHING


def _published(name: str, row: Row) -> tuple[float, float] | None:
    """Both figures, where the row is of the frames that they are known for."""
    every, seen, num_visible = PUBLISHED.get(name, (0.0, 0.0, -1))
    return (every, seen) if row["real"]["num_targets_visible_80"] == num_visible else None


def _frames(rows: Mapping[str, Row]) -> str:
    lines = [
        [
            name,
            f"{frame['scene_id']}/{frame['image_id']}",
            f"{frame['rotation_deg']:.1f}",
            f"{frame['translation_mm']:.1f}",
            f"{frame['add_diameters']:.3f}",
            f"{frame['confidence']:.2f}",
        ]
        for name, row in rows.items()
        for frame in row["frames"]
    ]
    head = ("class", "scene/image", "rotation, degrees", "position, mm", "ADD(-S), diameters", "confidence")
    return markdown_table(head, lines) if lines else ""


def _paper(table: Results) -> str:
    lines = [
        [name, _yes(row.labels_real), _yes(row.labels_synthetic), f"{row.mean:.1f}", *(f"{v:.1f}" for v in row.classes)]
        for name, row in LINEMOD.items()
    ]
    for method, rows in table.items():
        datasets = sorted({row["real"]["dataset"] for row in rows.values()})
        labels = [_yes(any(row[kind] for row in rows.values())) for kind in ("labels_real", "labels_synthetic")]
        for metric, title in (("add_recall", "all targets"), (_VISIBLE, "≥ 80 % visible")):
            found = {name: row["real"]["metrics"].get(metric) for name, row in rows.items()}
            values = [value for value in found.values() if value is not None]
            if values:
                cells = [_percent(found.get(name)) for name in LINEMOD_CLASSES]
                name = f"**here: `{method}`**, {' and '.join(datasets)}, {title}, mean of {len(values)}"
                lines.append([name, *labels, _percent(mean(values)), *cells])
    head = ("method", "real labels", "synthetic labels", "mean", *LINEMOD_CLASSES)
    note = (
        "ADD(-S) recall in per cent. The paper's rows are on LineMOD's own test frames, in which nothing hides the "
        "object; ours are on the data set that each names."
    )
    return f"{note}\n\n{markdown_table(head, lines)}"


def _percent(share: float | None) -> str:
    return _NOTHING if share is None else f"{100 * share:.1f}"


def _number(value: float | None, digits: int) -> str:
    return _NOTHING if value is None else f"{value:.{digits}f}"


def _interval(metrics: Mapping[str, float], name: str) -> str:
    if name not in metrics:
        return _NOTHING
    low, high = metrics[f"{name}_low"], metrics[f"{name}_high"]
    return f"{_percent(metrics[name])} ({100 * low:.0f}–{100 * high:.0f})"
