"""The LineMOD runs and models in a folder, each with what made it."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from curio_serve.models.model_folder import MODEL_FILE

from curio_train.errors import UsageError
from curio_train.exported_model import ExportedModel, find_model
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.learning.runs.configuration import CONFIG_FILE, to_portable
from curio_train.refinement.template_poses import uses_templates
from curio_train.worlds.options import LinemodOptions

SELF_TRAINED = ", self-trained"
"""Added to the method's name where real frames without labels were learned from."""

TWO_STAGES = ", two stages"
"""Added to the name of one of the paper's methods where it trained the two-stage detector."""

BY_TEMPLATES = ", templates"
"""Added to the name of a method that trained a locator, where templates tell the poses."""

ONE_STAGE_METHODS = ("our", "noncur", "super")


@dataclass(frozen=True)
class Candidate:
    """A run or a model of LineMOD."""

    path: Path
    """Its folder."""
    name: str
    """The class; several as on the command line."""
    method: str
    """Method that trained it; ``, two stages`` follows where it is one of the paper's and the network is not,
    ``, templates`` where a locator was trained, ``, self-trained`` where unlabelled real frames took part."""
    weights: Path
    """The last checkpoint's tensors, or the model file."""


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
    if not folder.exists():
        raise UsageError(f"{flag} {folder}: no such folder; expected runs or models of linemod there")
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
                yield Candidate(path, run.config.world.class_name, _method(to_portable(run.config)), weights)
        elif any(path.glob(f"[0-9]*/{MODEL_FILE}")):
            file = find_model(path)
            spec = ExportedModel.open(file).spec
            if spec.world == "linemod":
                names = ",".join(one.name for one in spec.objects)
                yield Candidate(path, names, _method(json.loads(spec.recipe)), file)


def _method(provenance: Mapping[str, Any]) -> str:
    """Models that are older than self-training, or than the two stages, say nothing of it."""
    name = str(provenance["method"])
    two_stages = name in ONE_STAGE_METHODS and provenance["world"].get("gaze", False)
    kind = TWO_STAGES * two_stages + BY_TEMPLATES * (name != "templates" and uses_templates(provenance, 1))
    return name + kind + SELF_TRAINED * bool(provenance["recipe"].get("self_training"))
