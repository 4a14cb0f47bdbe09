"""``docs/results/worlds.json``: what each method reaches in each world, and its ratio to full supervision.

::

    {world: {method: {img, para, img_ratio, para_ratio, per_parameter: {…}, per_parameter_ratio: {…}, by_seed: {…},
                      seeds, images_seen, seconds, machine, commit, label_free, synthetic_labels}}}

``img`` is DSSIM from the novel view, ``para`` is Eq. 1; ``super_1.0`` is the reference of all ratios, and all rows of
a world have seen as many images, but what begins as another run has seen as many again. Figures are means over the
seeds; ``by_seed`` has each seed's.
"""

import json
from collections.abc import Iterable, Mapping, Sequence, Set
from pathlib import Path
from statistics import mean
from typing import Any

from curio_train.config import METHODS
from curio_train.errors import DataError

Row = dict[str, Any]
Results = dict[str, dict[str, Row]]

REFERENCE = "super_1.0"
ORDER: Sequence[str] = (
    REFERENCE,
    "super_0.1",
    "super_0.05",
    "noncur",
    "our",
    "wake_sleep_critic",
    "wake_sleep",
    "sleep",
    "super_1.0_cells",
    "noncur_cells",
    "our_cells",
    "hypotheses_cells",
    "our_found_cells",
    "sleep_cells",
)
"""Of the methods in tables: the paper's, then what goes beyond it."""
WORLDS: Sequence[str] = ("circles", "spheres", "chairs", "varied", "multi", "light")
"""The paper's synthetic worlds, in its order."""

_FOUND = "_found"  # in the names of rows that begin as a run of hypotheses
_PARAMETERS = ("color_mse", "rotation_deg", "confidence_mse", "light_deg")
_M_PER_MM = 1e-3


def method_name(method: str, labels: float, reading: str, before: str | None) -> str:
    """The name of a row: of supervision with its share of labels, of images read by the dense decoder with those.

    Where a run began as one of ``hypotheses``, its row says so.
    """
    of_method = f"super_{labels:g}" if labels not in (0, 1) else REFERENCE if method == "super" else method
    of_method = of_method + _FOUND if before == "hypotheses" else of_method
    return of_method if reading == "whole" else f"{of_method}_{reading}"


def collect(evaluations: Iterable[Mapping[str, Any]]) -> Results:
    """Rows without ratios from what ``curio-eval`` found, one evaluation a run.

    Raises:
        DataError: Runs of one row saw different numbers of images.
    """
    runs: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for found in evaluations:
        name = method_name(found["method"], found["labels"], found["reading"], found.get("method_before"))
        runs.setdefault((found["world"], name), []).append(found)
    results: Results = {}
    for (world, method), of_row in runs.items():
        results.setdefault(world, {})[method] = _row(world, sorted(of_row, key=lambda found: found["seed"]))
    return results


def _row(world: str, runs: Sequence[Mapping[str, Any]]) -> Row:
    seen = {run["images_seen"] for run in runs}
    if len(seen) > 1:
        raise DataError(f"runs of {world}, {runs[0]['method']} saw {sorted(seen)} images; a row needs one budget")
    parameters = [_parameters(run["metrics"]) for run in runs]
    by_seed = {
        "img": [run["metrics"]["novel_view_dssim"] for run in runs],
        "para": [run["metrics"]["scene_error"] for run in runs],
        "seconds": [round(run["training_seconds"], 1) for run in runs],
        **{name: [one[name] for one in parameters] for name in parameters[0]},
    }
    terms = METHODS[runs[0]["method"]]
    return {
        **_means(by_seed),
        "by_seed": by_seed,
        "seeds": [run["seed"] for run in runs],
        "images_seen": runs[0]["images_seen"],
        "machine": runs[0]["machine"],
        "commit": runs[-1]["commit"],
        "label_free": not terms.label,
        "synthetic_labels": terms.sleep,
    }


def _means(by_seed: Mapping[str, Sequence[float]]) -> Row:
    means = {name: mean(values) for name, values in by_seed.items()}
    first = {name: means.pop(name) for name in ("img", "para")}
    seconds = round(means.pop("seconds"), 1)
    return {**first, "per_parameter": means, "seconds": seconds}


def _parameters(metrics: Mapping[str, float]) -> dict[str, float]:
    """Table 3's errors by parameter; position in metres, or image widths in 2D."""
    flat = "position_image_widths" in metrics
    position = metrics["position_image_widths"] if flat else metrics["position_mm"] * _M_PER_MM
    unit = "image_widths" if flat else "m"
    return {f"position_{unit}": position} | {name: metrics[name] for name in _PARAMETERS if name in metrics}


def merge(stored: Results, found: Results) -> Results:
    """Results with new rows in place of old ones, and all ratios.

    A world's old rows stay where they have the new ones' budget. Where both have the row, the old one's other seeds
    are joined to the new one.
    """
    merged: Results = {}
    for world in (name for name in WORLDS if name in stored or name in found):
        rows = dict(found.get(world, {}))
        budget = {_budget(*named) for named in rows.items()}
        for method, row in stored.get(world, {}).items():
            same_budget = not budget or _budget(method, row) in budget
            if same_budget:
                rows[method] = _joined(row, rows[method]) if method in rows else row
        reference = rows.get(REFERENCE)
        merged[world] = {name: _with_ratios(rows[name], reference) for name in ORDER if name in rows}
    return merged


def _budget(method: str, row: Row) -> int:
    """Images of a row's own runs: what begins as another run has seen that one's, too, and both see as many."""
    seen: int = row["images_seen"]
    return seen // 2 if _FOUND in method else seen


def _joined(old: Row, new: Row) -> Row:
    """The new row with the old one's other seeds; machine and commit are the new one's.

    Old rows of several seeds that lack each seed's parameters cannot be taken apart: the row with more seeds stays.
    """
    others = [number for number, seed in enumerate(old["seeds"]) if seed not in new["seeds"]]
    if not others:
        return new
    if not old["by_seed"].keys() >= new["by_seed"].keys():
        return old if len(old["seeds"]) > len(new["seeds"]) else new
    seeds = [*(old["seeds"][number] for number in others), *new["seeds"]]
    by_seed = {
        name: [*(old["by_seed"][name][number] for number in others), *values] for name, values in new["by_seed"].items()
    }
    order = sorted(range(len(seeds)), key=seeds.__getitem__)
    by_seed = {name: [values[number] for number in order] for name, values in by_seed.items()}
    return {**new, **_means(by_seed), "by_seed": by_seed, "seeds": sorted(seeds)}


def _with_ratios(row: Row, reference: Row | None) -> Row:
    """``None`` where the reference is not there yet, or is 0."""
    against = reference or {"per_parameter": {}}
    ratios = {f"{name}_ratio": _ratio(row[name], against.get(name)) for name in ("img", "para")}
    of_parameters = {
        name: _ratio(value, against["per_parameter"].get(name)) for name, value in row["per_parameter"].items()
    }
    first = {"img": row["img"], "para": row["para"], **ratios}
    first |= {"per_parameter": row["per_parameter"], "per_parameter_ratio": of_parameters}
    return first | {name: value for name, value in row.items() if name not in first}


def _ratio(value: float, reference: float | None) -> float | None:
    return value / reference if reference else None


def load_results(file: Path) -> Results:
    """What was found so far; nothing where there is no file.

    Raises:
        DataError: The file cannot be read, or is none of results.
    """
    return load_rows(file, {"img", "para", "per_parameter", "seeds", "images_seen"}, "results of worlds")


def load_rows(file: Path, required: Set[str], what: str) -> Results:
    """Rows by group and name; none where there is no file.

    Args:
        file: Written by :func:`save_results`.
        required: Keys that every row must have.
        what: It holds, for the message.

    Raises:
        DataError: The file cannot be read, or holds something else.
    """
    if not file.exists():
        return {}
    try:
        stored: Results = json.loads(file.read_text(encoding="utf-8"))
        for rows in stored.values():
            for row in rows.values():
                if not row.keys() >= required:
                    raise ValueError(f"a row lacks {sorted(required - row.keys())}")
    except (OSError, ValueError, AttributeError) as exc:
        raise DataError(f"{file} holds no {what} ({exc}); restore it, or delete it to begin anew") from exc
    return stored


def save_results(file: Path, results: Results) -> None:
    """Write whole or not at all.

    Raises:
        DataError: The file cannot be written.
    """
    draft = file.with_suffix(".tmp")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        draft.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
        draft.replace(file)
    except OSError as exc:
        raise DataError(f"cannot write {file}: {exc.strerror}; name a file that can be written: --results") from exc


def markdown_table(headings: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table as Markdown has it, of cells that are text."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (headings, ["---"] * len(headings), *lines))
