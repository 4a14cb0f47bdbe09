"""``docs/results/linemod.json``: what a network a class reaches on held-out renderings and on real frames.

::

    {method: {class: {weights_sha256, num_images, real_sha256, labels_real, labels_synthetic, rendered: {…}, real: {…},
                      frames: […], images_seen, training_seconds, preset, seed, commit, machine}}}

Beside each method stands the same followed by ``, refined``: its poses after render-and-compare, see
``curio_train.refinement``. ``frames`` are single frames of a second data set, each with its errors. A
row is kept as long as weights, number of renderings and real labels are those that it was made of.
"""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from curio_train.errors import DataError
from curio_train.evaluation.unlabelled.candidates import Candidate
from curio_train.worlds.options import ALL_CLASSES

from paper.results import Results, Row, load_rows

REFINED = ", refined"
"""What follows the method's name where poses were refined."""

_KEPT = ("labels_real", "labels_synthetic", "images_seen", "training_seconds", "preset", "seed", "commit", "machine")
_RENDERED = ("add_recall", "rotation_deg_median", "translation_mm_median", "confidence_ece", "present_auroc")
_REQUIRED = {"weights_sha256", "num_images", "real_sha256", "rendered", "real", *_KEPT}


def is_of_one_class(candidate: Candidate) -> bool:
    """Whether it finds one class, as rows of the table do."""
    return candidate.name != ALL_CLASSES and "," not in candidate.name


def files_sha256(*files: Path) -> str:
    """SHA-256 of the contents of some files, one after the other.

    Raises:
        DataError: One cannot be read.
    """
    digest = hashlib.sha256()
    for file in files:
        try:
            digest.update(file.read_bytes())
        except OSError as exc:
            raise DataError(f"{file}: cannot be read ({exc.strerror})") from exc
    return digest.hexdigest()


def labels_sha256(data: Path) -> str:
    """Which real frames these are: a digest of all their labels."""
    return files_sha256(*sorted(data.glob("test/*/scene_gt.json")))


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
        "weights_sha256": files_sha256(candidate.weights),
        "num_images": result["num_images"],
        "real_sha256": labels_sha256(data),
        **{name: result[name] for name in _KEPT},
        "rendered": {name: result["metrics"][name] for name in _RENDERED if name in result["metrics"]},
        "real": {name: value for name, value in real.items() if name != "targets"},
        "frames": list(frames),
    }


def is_current(row: Row | None, candidate: Candidate, num_images: int, data: Path) -> bool:
    """Whether a stored row is of these weights, as many renderings and these real frames."""
    made_of = (files_sha256(candidate.weights), num_images, labels_sha256(data))
    return row is not None and made_of == (row["weights_sha256"], row["num_images"], row["real_sha256"])


def load_table(file: Path) -> Results:
    """The rows so far; none where there is no file.

    Raises:
        DataError: The file cannot be read, or holds something else.
    """
    return load_rows(file, _REQUIRED, "LineMOD results")
