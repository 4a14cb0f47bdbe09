"""``report.html`` of a run: one file with its pictures inside, which opens without a server.

After training it shows training images and how far their re-renderings are from them, for which no label is needed;
``curio-eval`` writes it again with the images it scored and every error it found.
"""

import importlib.metadata
import json
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from curio_serve.files import write_whole
from jinja2 import Environment, PackageLoader, TemplateError
from torch import Tensor

from curio_train.errors import CheckpointError, DataError, ReportError
from curio_train.evaluation.reporting import report_figures as figures
from curio_train.evaluation.reporting.tables import apart, label
from curio_train.evaluation.subject import Subject, load_subject
from curio_train.evaluation.unlabelled.photographed import Judgement, judge
from curio_train.export.card import JUDGEMENT_FILE
from curio_train.learning.runs.checkpoint import CONFIG_FILE
from curio_train.learning.runs.configuration import world_name
from curio_train.learning.runs.progress import read_history, stage_pictures
from curio_train.learning.runs.provenance import RunSession, run_sessions
from curio_train.metrics.images import dssim
from curio_train.worlds.base import Split

REPORT_FILE = "report.html"
_NUM_SAMPLES = 6
_NUM_PHOTOGRAPHS = 24
_NUM_COMPARED = 48  # training images whose re-renderings are compared with them; fewer where nothing was trained
_LIBRARIES = ("curio-pose", "torch", "mitsuba", "drjit", "numpy")


def keep(file: Path, result: Mapping[str, Any]) -> None:
    """Write a result as JSON into a run folder, whole or not at all; export and reports read it.

    Raises:
        CheckpointError: The run folder cannot be written.
    """
    try:
        write_whole(file, json.dumps(result, indent=2))
    except OSError as exc:
        raise CheckpointError(f"cannot write {file}: {exc.strerror}; make the run folder writable") from exc


def report_training(run: Path, cache: Path) -> str:
    """The report of a run that has just ended. Opens no label file.

    Returns:
        The verdict on the model by photographs; empty where there are none to judge by.

    Raises:
        CurioError: The report could not be made. The run is none the worse.
    """
    subject = load_subject(run)
    try:
        judgement = judge(subject.world, subject.predict)
        if judgement is not None:
            keep(run / JUDGEMENT_FILE, {"images_seen": subject.images_seen, **judgement.summary})
    except DataError as exc:
        raise ReportError(f"{run / REPORT_FILE} could not be written ({exc}); the run itself is whole") from exc
    write_report(run, subject, "train", cache, judgement=judgement)
    return "" if judgement is None else judgement.verdict


def write_report(
    run: Path,
    subject: Subject,
    split: Split,
    cache: Path,
    errors: Mapping[str, Tensor] | None = None,
    evaluation: Mapping[str, Any] | None = None,
    judgement: Judgement | None = None,
) -> None:
    """Draw and write the report.

    Args:
        run: The run folder.
        subject: Its network.
        split: Where the sample images are from.
        cache: Where worlds keep their image sets.
        errors: Each single error by metric, see :func:`~curio_train.evaluation.scores.scene_errors`; without them the
            differences of images and re-renderings are shown.
        evaluation: What ``curio-eval`` found, if it did.
        judgement: By photographs, if there are some.

    Raises:
        ReportError: Something about it failed.
    """
    try:
        html = _page(run, subject, split, cache, errors, evaluation, judgement)
        write_whole(run / REPORT_FILE, html)
    except (DataError, CheckpointError) as exc:
        raise ReportError(f"{run / REPORT_FILE} could not be written ({exc}); the run itself is whole") from exc
    except (OSError, LookupError, RuntimeError, TemplateError, TypeError, ValueError, MemoryError) as exc:
        raise ReportError(
            f"{run / REPORT_FILE} could not be written ({type(exc).__name__}: {exc}); the run itself is whole, and "
            f"curio-eval {run} writes its report anew"
        ) from exc


@torch.no_grad()
def _page(
    run: Path,
    subject: Subject,
    split: Split,
    cache: Path,
    errors: Mapping[str, Tensor] | None,
    evaluation: Mapping[str, Any] | None,
    judgement: Judgement | None,
) -> str:
    world, config = subject.world, subject.config
    source = world.source(split, config.seed, with_code=False, cache=cache)
    batch = source.batch(0, _NUM_SAMPLES if errors or config.terms.templates else _NUM_COMPARED)
    code = subject.predict((batch.images.clamp(0, 1) * 255).round().byte())
    rendered = world.render(code, batch.backgrounds).clamp(0, 1)
    columns = (batch.images, rendered, world.novel_view(code).clamp(0, 1))
    shown = errors or {"image_dssim": dssim(rendered, batch.images)}
    made, parts = run_sessions(run), [kind.name for kind in world.objects]
    history = read_history(run)
    pages = Environment(loader=PackageLoader("curio_train.evaluation.reporting", ""), autoescape=True)
    return pages.get_template("report.html.jinja").render(
        title=f"{world_name(config)}: {', '.join(parts)}; {config.method}, seed {config.seed}",
        facts=_facts(subject, made),
        run_sessions=made,
        stages=[(f"{images:,}", figures.uri(path.read_bytes())) for images, path in stage_pictures(run)],
        split=split,
        num_images=evaluation["num_images"] if evaluation else len(batch.images),
        samples=figures.samples([column[:_NUM_SAMPLES] for column in columns]),
        judgement=judgement,
        judged=None if judgement is None else _judged(judgement),
        curves=figures.curves(history),
        error_over_time=figures.error_over_time(history),
        reliability=_reliability(evaluation or {}),
        histograms=figures.histograms({label(name): values for name, values in shown.items()}),
        scores=_scores(evaluation or {}),
        configuration=(run / CONFIG_FILE).read_text(encoding="utf-8"),
    )


def _judged(judgement: Judgement) -> str:
    """Photographs and what was found in them from each camera, the worst first, with their figures."""
    columns = [column[:_NUM_PHOTOGRAPHS] for column in judgement.columns.values()]
    return figures.samples(columns, tuple(judgement.columns), judgement.captions[:_NUM_PHOTOGRAPHS])


def _facts(subject: Subject, made: list[RunSession]) -> dict[str, str]:
    """Facts of the run: command, date, machine, budget."""
    minutes = subject.training_seconds / 60
    rate = subject.images_seen / max(subject.training_seconds, 1e-9)
    versions = {name: importlib.metadata.version(name) for name in _LIBRARIES}
    return {
        "images seen": f"{subject.images_seen:,}",
        "training time": f"{minutes:.1f} minutes, {rate:.0f} images/s",
        "started": made[0].started,
        "last session": made[-1].started,
        "machine": made[-1].machine,
        "system": f"{platform.system()} {platform.release()}, Python {platform.python_version()}",
        "libraries": ", ".join(f"{name} {number}" for name, number in versions.items()),
    }


def _reliability(evaluation: Mapping[str, Any]) -> str | None:
    """The reliability diagrams of whatever was scored; None if its poses have no confidence."""
    found = {"renderings": evaluation, "real frames": evaluation.get("real", {})}
    bins = {name: scored["reliability"] for name, scored in found.items() if "reliability" in scored}
    return figures.reliability(bins) if bins else None


def _scores(evaluation: Mapping[str, Any]) -> dict[str, list[tuple[str, str, str]]]:
    """By statistic, rows of metric, this network's figure, the untrained one's; real frames have only the first."""
    untrained, rows = evaluation.get("untrained", {}), dict[str, list[tuple[str, str, str]]]()
    scored, real = _metrics(evaluation), _metrics(evaluation.get("real", {}))
    for statistic, names in apart(scored).items():
        rows[statistic] = [(label(name), f"{scored[name]:.4g}", f"{untrained[name]:.4g}") for name in names]
    for statistic, names in apart(real).items():
        rows[f"real frames: {statistic}"] = [(label(name), f"{real[name]:.4g}", "") for name in names]
    return rows


def _metrics(scored: Mapping[str, Any]) -> Mapping[str, float]:
    found: Mapping[str, float] = scored.get("metrics", {})
    return found
