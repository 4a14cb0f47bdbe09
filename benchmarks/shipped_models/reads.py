"""What the confidence of several reads has to be raised to, so that it is the probability of a right pose.

    python benchmarks/shipped_models/reads.py models/lmo --data DIR [--json]

Renderings are read nine times. First single reads' confidences are calibrated by a power of their own, because a model
may be calibrated for photographs; then, for the first reads of each image together, the power is found that makes the
confidence of their consensus likeliest (``curio_serve.models.repeated.AGREEMENT_POWER`` is built in).

power           likeliest power
ece             calibration error with it
ece_of_share    without any power
ece_built_in    with the power that is built in
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from curio_serve.models.repeated import AGREEMENT_POWER, MAX_READS, RepeatedReader
from curio_train.commands.command_line.running import CACHE
from curio_train.evaluation.evaluate import draw
from curio_train.evaluation.scores import add_errors
from curio_train.evaluation.subject import load_subject
from curio_train.export.spec import model_spec
from curio_train.learning.runs.provenance import machine
from curio_train.metrics.calibration import calibration_error
from curio_train.metrics.poses import ADD_THRESHOLD
from curio_train.scene_code import CONFIDENCE, SceneCode, index, poses
from curio_train.worlds.several_objects.world import SeveralObjectsWorld

Outputs = dict[str, np.ndarray]
NUM_READS = (2, 3, 5, 7, 9)
POWERS = np.arange(0.1, 1.3, 0.05)
_EVERY = 20  # vertices that ADD is measured at


@dataclass(frozen=True)
class Settings:
    """Fit the power."""

    model: tyro.conf.Positional[Path]
    """Of several objects."""
    data: Path
    """BOP data set with their meshes."""
    num_images: int = 56
    """Renderings of the test split."""
    json: bool = False
    """Print one JSON object on the last line."""
    cache: Path = CACHE
    """Where clutter is kept."""


def main() -> None:
    """Read, fit, print."""
    settings = tyro.cli(Settings)
    subject = load_subject(settings.model, settings.data)
    world, held_out = subject.world, draw(subject.world, "test", settings.num_images, settings.cache)
    assert isinstance(world, SeveralObjectsWorld)  # other models' frames show one object
    read: list[Outputs] = []

    def predict(images: np.ndarray) -> Outputs:
        code = subject.predict(torch.from_numpy(images).permute(0, 3, 1, 2).contiguous())
        read.append({name: values.numpy() for name, values in world.outputs.from_code(code).items()})
        return copied(read[-1])

    spec = model_spec(world, settings.model.name)
    for image in held_out.images:
        RepeatedReader(spec, predict, MAX_READS)(image.permute(1, 2, 0).numpy()[None])

    def answers(num_reads: int, power: float) -> Outputs:
        """Consensus of the first reads of each image, whose confidences are raised to a power."""
        rows = []
        for first in range(0, len(read), MAX_READS):
            own = iter(read[first : first + num_reads])
            if num_reads == 1:
                rows.append(raised(next(own), power))
            else:
                reader = RepeatedReader(spec, lambda _, own=own: raised(next(own), power), num_reads)
                rows.append(reader(np.zeros((1, 2, 2, 3), np.uint8)))
        return {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}

    single = scored(world, answers(1, 1.0), held_out.code)
    calibrating = likeliest(*single)
    figures = {
        "model": settings.model.name,
        "images": settings.num_images,
        "poses": len(single[0]),
        "single": {
            "power": calibrating,
            "right": float(np.mean(single[1])),
            "ece": calibration_error(single[0] ** calibrating, single[1]),
        },
        "by_reads": {str(num): agreement(num, answers, calibrating, world, held_out.code) for num in NUM_READS},
        "built_in": AGREEMENT_POWER,
        "machine": machine(),
    }
    print(json.dumps(figures, indent=None if settings.json else 1))


def agreement(
    num_reads: int,
    answers: Callable[[int, float], Outputs],
    calibrating: float,
    world: SeveralObjectsWorld,
    true: SceneCode,
) -> dict[str, float]:
    """Figures of one number of reads."""
    confidence, correct = scored(world, answers(num_reads, calibrating), true)
    share = confidence ** (1 / AGREEMENT_POWER)
    power = likeliest(share, correct)
    return {
        "right": float(np.mean(correct)),
        "power": power,
        "ece": calibration_error(share**power, correct),
        "ece_of_share": calibration_error(share, correct),
        "ece_built_in": calibration_error(confidence, correct),
    }


def scored(world: SeveralObjectsWorld, outputs: Outputs, true: SceneCode) -> tuple[np.ndarray, list[bool]]:
    """Confidences of the objects that are shown, and whether their poses are right by ADD(-S) < 0.1 d."""
    code = world.outputs.to_code({name: torch.from_numpy(values) for name, values in outputs.items()})
    there, confidences, correct = true[CONFIDENCE][..., 0] > 0, [], []
    for slot, member in enumerate(world.members):
        found, wanted = (poses(index(one, there[:, slot]), slot) for one in (code, true))
        errors = add_errors(found, wanted, member.mesh.vertices_m[::_EVERY], member.kind.info)
        confidences += code[CONFIDENCE][there[:, slot], slot, 0].tolist()
        correct += [bool(error < ADD_THRESHOLD) for error in errors]
    return np.array(confidences), correct


def likeliest(confidence: np.ndarray, correct: Sequence[bool]) -> float:
    """The power of confidences that makes what is correct likeliest."""

    def surprise(power: float) -> float:
        raised = np.clip(confidence**power, 1e-4, 1 - 1e-4)
        return -float(np.log(np.where(correct, raised, 1 - raised)).mean())

    return round(float(min(POWERS, key=surprise)), 2)


def copied(outputs: Outputs) -> Outputs:
    """The same in arrays of their own: readers change them."""
    return {name: values.copy() for name, values in outputs.items()}


def raised(outputs: Outputs, power: float) -> Outputs:
    """The same with confidences raised to a power."""
    return copied(outputs) | {"confidence": outputs["confidence"] ** power}


if __name__ == "__main__":
    main()
