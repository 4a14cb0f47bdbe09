"""``docs/results/linemod.json``: what a network a class reaches on held-out renderings and on real frames.

::

    {method: {class: {weights_sha256, num_images, real_sha256, labels_real, labels_synthetic, rendered: {…}, real: {…},
                      frames: […], images_seen, training_seconds, preset, seed, commit, machine}}}

Beside each method stands the same followed by ``, refined``: its poses after render-and-compare, see
:mod:`~curio_train.worlds.refinement`. ``frames`` are single frames of a second data set, each with its errors. A
row is kept as long as weights, number of renderings and real labels are those that it was made of.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from curio_train.errors import DataError, UsageError
from curio_train.evaluation.results import Results, Row, load_rows
from curio_train.learning.checkpoint import RunFolder
from curio_train.learning.configuration import CONFIG_FILE, to_portable
from curio_train.model_folder import MODEL_FILE, find_model
from curio_train.onnx_file import OnnxModel
from curio_train.worlds.options import LinemodOptions

SELF_TRAINED = ", self-trained"
"""What follows the method's name where real frames without labels were learned from."""

REFINED = ", refined"
"""What follows the method's name where poses were refined."""

_KEPT = ("labels_real", "labels_synthetic", "images_seen", "training_seconds", "preset", "seed", "commit", "machine")
_RENDERED = ("add_recall", "rotation_deg_median", "translation_mm_median", "confidence_ece", "present_auroc")
_REQUIRED = {"weights_sha256", "num_images", "real_sha256", "rendered", "real", *_KEPT}


@dataclass(frozen=True)
class Candidate:
    """A run or a model of one LineMOD class.

    Attributes:
        path: Its folder.
        name: The class.
        method: That trained it; ``, self-trained`` follows where unlabelled real frames took part.
        weights_sha256: Of the last checkpoint's tensors, or of the model file.
    """

    path: Path
    name: str
    method: str
    weights_sha256: str


def candidates(folder: Path, flag: str = "--runs", *, of_any_method: bool = True) -> list[Candidate]:
    """The LineMOD runs and models in a folder, or the one that it is.

    Args:
        folder: Where they lie.
        flag: That named it, for messages.
        of_any_method: A class may be there once a method; else once.

    Raises:
        UsageError: There is none, or there are several of one kind.
        CheckpointError: A run is damaged or has no checkpoint.
        ExportError: A model is damaged.
    """
    found = list(_found(folder))
    if not found:
        raise UsageError(f"{flag} {folder}: found no run folder and no model of linemod; expected one a class")
    first: dict[str, Candidate] = {}
    for one in found:
        kind = f"{one.name} by {one.method}" if of_any_method else one.name
        other = first.setdefault(kind, one)
        if other is not one:
            expected = "one run a class and method" if of_any_method else "one of each object"
            raise UsageError(
                f"{flag} {folder}: found {other.path.name} and {one.path.name}, both {kind}; expected {expected}"
            )
    return found


def _found(folder: Path) -> Iterator[Candidate]:
    for path in [folder, *sorted(folder.glob("*"))]:
        if (path / CONFIG_FILE).exists():
            run = RunFolder.open(path)
            if isinstance(run.config.world, LinemodOptions) and run.checkpoints():
                weights = run.checkpoints()[-1] / "tensors.safetensors"
                yield Candidate(path, run.config.world.class_name, _method(to_portable(run.config)), _sha256(weights))
        elif any(path.glob(f"[0-9]*/{MODEL_FILE}")):
            file = find_model(path)
            spec = OnnxModel.open(file).spec
            if spec.world == "linemod":
                yield Candidate(path, spec.objects[0].name, _method(json.loads(spec.recipe)), _sha256(file))


def _method(making: Mapping[str, Any]) -> str:
    """Models that are older than self-training say nothing of it."""
    return str(making["method"]) + (SELF_TRAINED if making["recipe"].get("self_training") else "")


def _sha256(*files: Path) -> str:
    digest = hashlib.sha256()
    for file in files:
        try:
            digest.update(file.read_bytes())
        except OSError as exc:
            raise DataError(f"{file}: cannot be read ({exc.strerror})") from exc
    return digest.hexdigest()


def labels_sha256(data: Path) -> str:
    """Which real frames these are: a digest of all their labels."""
    return _sha256(*sorted(data.glob("test/*/scene_gt.json")))


def make_row(result: Mapping[str, Any], candidate: Candidate, data: Path, frames: Sequence[Row]) -> Row:
    """A row from what ``curio-eval --data`` found; nothing in it names a folder of this machine.

    Args:
        result: Of :func:`~curio_train.evaluation.evaluate.evaluate`.
        candidate: What was scored.
        data: The real frames.
        frames: Single frames of another data set, with their errors.
    """
    real = result["real"]
    return {
        "weights_sha256": candidate.weights_sha256,
        "num_images": result["num_images"],
        "real_sha256": labels_sha256(data),
        **{name: result[name] for name in _KEPT},
        "rendered": {name: result["metrics"][name] for name in _RENDERED if name in result["metrics"]},
        "real": {name: value for name, value in real.items() if name != "targets"},
        "frames": list(frames),
    }


def is_current(row: Row | None, candidate: Candidate, num_images: int, data: Path) -> bool:
    """Whether a stored row is of these weights, as many renderings and these real frames."""
    made_of = (candidate.weights_sha256, num_images, labels_sha256(data))
    return row is not None and made_of == (row["weights_sha256"], row["num_images"], row["real_sha256"])


def load_table(file: Path) -> Results:
    """The rows so far; none where there is no file.

    Raises:
        DataError: The file cannot be read, or holds something else.
    """
    return load_rows(file, _REQUIRED, "LineMOD results")
