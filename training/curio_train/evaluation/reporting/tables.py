"""Results as tables for people."""

from collections.abc import Iterable, Mapping
from typing import Any

from rich.console import Console
from rich.table import Table

_LABELS: Mapping[str, str] = {
    "scene_error": "scene error, Eq. 1",
    "scene_error_any_shape": "scene error by position alone, shapes aside",
    "novel_view_dssim": "novel view, DSSIM",
    "image_dssim": "image and re-rendering, DSSIM",
    "position_image_widths": "position, image widths",
    "position_px": "position, pixels",
    "position_px_median": "position, pixels, median",
    "position_mm": "position, mm",
    "color_mse": "colour, squared error",
    "rotation_deg": "rotation, degrees",
    "confidence_mse": "confidence, squared error",
    "light_deg": "light direction, degrees",
    "add_recall": "ADD(-S) below 0.1 diameters, fraction",
    "add_recall_low": "   95 % interval from",
    "add_recall_high": "   to",
    "add_recall_visible_80": "ADD(-S) below 0.1 diameters, at least 80 % visible",
    "add_recall_visible_80_low": "   95 % interval from",
    "add_recall_visible_80_high": "   to",
    "rotation_deg_median": "rotation, degrees, median",
    "translation_mm_median": "position, mm, median",
    "lateral_mm_median": "   across the view (x, y)",
    "depth_mm_median": "   along it (z)",
    "rotation_deg_median_mean": "rotation, degrees, mean of the objects' medians",
    "translation_mm_median_mean": "position, mm, mean of the objects' medians",
    "lateral_mm_median_mean": "   across the view (x, y)",
    "depth_mm_median_mean": "   along it (z)",
    "confidence_ece": "confidence, expected calibration error",
    "present_auroc": "object present or absent, AUROC",
    "mssd_recall": "MSSD, average recall",
    "mspd_recall": "MSPD, average recall",
    "own_view_inside": "own camera, agreement inside the silhouette",
    "own_view_overlap": "   overlap with what differs from the background image",
    "own_view_explained": "   explained of what stands out",
    "own_view_agreeing": "   photographs that agree, fraction",
    "own_view_dssim": "own camera, DSSIM",
    "own_view_dssim_blurred": "   both blurred",
    "own_view_plate_dssim": "   of the empty background image",
    "own_view_plate_dssim_blurred": "   of the empty background image, both blurred",
    "second_view_dssim": "second camera, DSSIM",
    "second_view_dssim_blurred": "   both blurred",
    "second_view_plate_dssim": "   of the empty background image",
    "second_view_plate_dssim_blurred": "   of the empty background image, both blurred",
    "better_than_plate": "nearer to the photograph than the background image, fraction",
}


def label(metric: str) -> str:
    """A metric's name for people."""
    return _LABELS.get(metric, metric)


def apart(metrics: Iterable[str]) -> dict[str, list[str]]:
    """Names of metrics by the statistic that they are: means and fractions, or medians; no table has both."""
    groups: dict[str, list[str]] = {"means and fractions": [], "medians": []}
    for name in metrics:
        groups["medians" if name.endswith("_median") else "means and fractions"].append(name)
    return {statistic: names for statistic, names in groups.items() if names}


def print_evaluation(result: Mapping[str, Any], console: Console) -> None:
    """The result of :func:`~curio_train.evaluation.evaluate.evaluate`."""
    objects, minutes = ", ".join(result["objects"]), result["training_seconds"] / 60
    console.print(
        f"{result['source']}: {result['world']} ({objects}), method {result['method']}, preset {result['preset']}, "
        f"seed {result['seed']}, {result['images_seen']:,} images seen in {minutes:.1f} minutes",
        markup=False,
        soft_wrap=True,
    )
    refined = result.get("refined")
    columns = {"this": result["metrics"], "untrained": result["untrained"]}
    columns |= {"refined": refined["metrics"]} if refined else {}
    _print_tables(f"{result['num_images']} images of the {result['split']} split", columns, console)
    if "real" in result:
        _print_real(result["real"], refined and refined["real"], console)
    if "photographs" in result:
        _print_photographs(result["photographs"], console)


def _print_photographs(found: Mapping[str, Any], console: Console) -> None:
    title = f"{found['num_photographs']} photographs, without labels"
    _print_tables(title, {"this": found["metrics"]}, console)
    console.print(found["verdict"], markup=False)


def _print_tables(title: str, columns: Mapping[str, Mapping[str, float]], console: Console) -> None:
    """A table of each statistic, a row a metric of the first column."""
    first = next(iter(columns.values()))
    for statistic, names in apart(first).items():
        table = Table(title=f"{title}: {statistic}", title_justify="left")
        table.add_column("metric")
        for heading in columns:
            table.add_column(heading, justify="right")
        for name in names:
            table.add_row(label(name), *(f"{found[name]:.4g}" for found in columns.values()))
        console.print(table)


def _print_real(real: Mapping[str, Any], refined: Mapping[str, Any] | None, console: Console) -> None:
    title = f"{real['num_targets']} real targets of {real['dataset']}, {real['split']}: {real['split_name']}"
    columns = {"this": real["metrics"] | _bins(real)}
    columns |= {"refined": refined["metrics"] | _bins(refined)} if refined else {}
    _print_tables(title, columns, console)


def _bins(real: Mapping[str, Any]) -> dict[str, float]:
    """Recall in bins of the visible fraction, by their names for people."""
    return {
        f"ADD(-S), {100 * row['from']:.0f}–{100 * row['to']:.0f} % visible, {row['num_targets']} targets": row[
            "add_recall"
        ]
        for row in real["by_visibility"]
    }
