"""From a run to a model that any runtime can serve: encoder and heads alone, checked against the trained network."""

import copy
import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
import torch
from curio_proto.v1.model_spec_pb2 import ModelSpec
from curio_serve.models.golden import GOLDEN_FILE, LARGEST_DIFFERENCE
from curio_serve.models.model_folder import MODEL_FILE
from jaxtyping import Bool
from torch import Tensor, nn

from curio_train.config import RunConfig
from curio_train.errors import ExportError, UsageError
from curio_train.export.card import Provenance, card
from curio_train.export.folder import ModelFolder, triton_config
from curio_train.export.graph import TRAIN_ON, Graph, decided_images, deployable, pixels_of
from curio_train.export.int8 import rounded_otherwise
from curio_train.export.onnx import put_spec, store_half
from curio_train.export.parity import largest_difference, refuse_disparity
from curio_train.export.spec import model_spec, stable_poses_file
from curio_train.export.stages import num_choosable, traced
from curio_train.exported_model import WEIGHTS_FILE, ExportedModel
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.learning.runs.configuration import to_portable
from curio_train.learning.runs.initial import method_before, weights_file
from curio_train.learning.runs.provenance import run_sessions
from curio_train.learning.state import TrainingProgress
from curio_train.networks.several_objects.network import ObjectsNetwork
from curio_train.networks.templates.quick_trunk import quicken
from curio_train.networks.templates.trunk import Trunk
from curio_train.worlds import build
from curio_train.worlds.base import World
from curio_train.worlds.single_object.two_stage import TwoStageWorld

_FAST = (
    "; looks at each object once, in one crop of half the resolution (--fast), which the confidence was not calibrated "
    "for"
)
_OF_TEMPLATES = (
    "Its templates hardly match renderings of it: say more of what it looks like (--background or --paint, "
    "--upright, narrower --near-m and --far-m), or train it by another --method"
)
_LARGEST_STEP = LARGEST_DIFFERENCE / 2  # that rounding may move an answer in int8 by


@dataclass(frozen=True)
class Reduced:
    """A graph that computes with fewer bits."""

    model: onnx.ModelProto
    """The graph, with the same inputs and outputs."""
    weights: str
    """How weights are stored, and what that costs, for the card."""


Reduce = Callable[[World, onnx.ModelProto], Reduced]
"""Makes it of a world's float32 graph, or raises ExportError where that costs too much."""


@dataclass(frozen=True)
class Exported:
    """The result of an export."""

    path: Path
    """The version's folder."""
    parity_error: float
    """Largest absolute difference between the network, its weights rounded as stored, and onnxruntime."""
    rounding_error: float
    """Largest absolute difference between what was written and the network that was trained, in answers that the last
    digits of an image do not decide; 0 in float32."""
    num_bytes: int
    """Size of model.onnx."""
    weights: str
    """How weights are stored, and what that costs."""


def export(
    run: Path,
    out: Path,
    name: str | None = None,
    *,
    half: bool = False,
    fast: bool = False,
    reduce: Reduce | None = None,
    ahead: Callable[[Graph], onnx.ModelProto | None] = lambda graph: None,
    report: Callable[[], object] = lambda: None,
) -> Exported:
    """Write the network of a run as the next version of a model.

    Args:
        run: The run folder. Its training images are not needed.
        out: Folder of models.
        name: Of the model; unless given, made of the object's: a LineMOD class or the name of a mesh file.
        half: Store weights as float16, half as large; they are computed with in float32.
        fast: Let a detector for several objects look at each once, in one crop of half the resolution.
        reduce: Applied to the float32 graph once that agrees with torch; stores the rest as ``half`` says.
        ahead: Gives the traced graph, where it has been traced before; not together with ``half``.
        report: Returns once the run's report is written, which the card quotes.

    Raises:
        UsageError: The name cannot be a model's, the folder is something else, or the network cannot be faster.
        CheckpointError: The run is missing, damaged or without a checkpoint.
        ExportError: torch and onnxruntime disagree, ``reduce`` costs too much, or the model cannot be written; nothing
            is left behind.
    """
    folder = RunFolder.open(run)
    world = build(folder.config.world)
    target = ModelFolder.named(out, ModelFolder.fitting_name(world.model_name) if name is None else name)
    state = folder.trained(world)
    if fast:
        _look_less(state.pose.network, run, folder.config)
    trained = Graph(state.pose.network, world)
    deployed = Graph(deployable(state.pose.network, half), world)
    images, stable = _decided_images(deployed.network if half else trained.network, world, folder.config)
    with torch.no_grad():
        learned = trained.in_parts(pixels_of(images))
        expected = deployed.in_parts(pixels_of(images)) if half else learned
    shapes = {name: tuple(values.shape[1:]) for name, values in expected.items()}
    config = triton_config(target.path.name, tuple(images.shape[1:]), shapes)
    target.refuse_other_tensors(config)
    rounding_error = largest_difference(deployed.where(stable, learned), deployed.where(stable, expected))
    model = ahead(deployed) or traced(deployed, deployed.network, world.camera, list(expected))
    if half and reduce is None:
        store_half(model)
    sessions = run_sessions(run)
    spec = model_spec(world, target.path.name)
    _describe(spec, folder.config, sessions[0].commit, state.progress)
    put_spec(model, spec)

    found = ExportedModel(model.SerializeToString(), "the exported graph")(images)
    weights = _weights(half, rounding_error)
    parity_error = refuse_disparity(deployed.where(stable, expected), deployed.where(stable, found))
    if reduce is not None:
        reduced = reduce(world, model)
        model, weights = reduced.model, reduced.weights
        put_spec(model, spec)
        found = ExportedModel(model.SerializeToString(), "the reduced graph")(images)
        stable = _unmoved_by_rounding(deployed, model, images, found, stable)
        rounding_error = largest_difference(deployed.where(stable, learned), deployed.where(stable, found))
    spec.parity_max_abs_error = parity_error if reduce is None else rounding_error
    put_spec(model, spec)
    version = target.next_version()
    pretrained = _uses_pretrained(state.pose.network, world, folder.config)
    chooses, is_reduced = num_choosable(state.pose.network) is not None, fast or reduce is not None
    made = Provenance(
        run, folder.config, sessions, state.progress, weights + _FAST * fast, pretrained, chooses, is_reduced
    )
    report()
    text = card(version, spec, shapes, world.objects, made)
    files = stable_poses_file(world) | {
        MODEL_FILE: model.SerializeToString(),
        GOLDEN_FILE: _golden(images, deployed, stable, found),
        WEIGHTS_FILE: weights_file(state, folder.config, half=half),
    }
    return Exported(target.add(version, files, config, text), parity_error, rounding_error, model.ByteSize(), weights)


def _decided_images(network: nn.Module, world: World, config: RunConfig) -> tuple[Tensor, Bool[Tensor, "batch slots"]]:
    """Check images and the stable answers; a copy of the network reads quickly, and itself can still be traced."""
    network = copy.deepcopy(network)
    quicken(network)
    return decided_images(Graph(network, world), world, _OF_TEMPLATES if config.terms.templates else TRAIN_ON)


def _unmoved_by_rounding(
    graph: Graph, model: onnx.ModelProto, images: Tensor, found: Mapping[str, Tensor], stable: Tensor
) -> Tensor:
    """Which of a reduced graph's stable answers stay where processors round in another way, [batch, slots]."""
    others = [ExportedModel(other.SerializeToString(), "its check")(images) for other in rounded_otherwise(model)]
    unmoved = torch.stack([stable, *(graph.unmoved(found, other, _LARGEST_STEP) for other in others)]).all(dim=0)
    if not unmoved.any():
        raise ExportError("in int8 every answer to check images hangs on rounding; export without --int8")
    return unmoved


def _uses_pretrained(network: nn.Module, world: World, config: RunConfig) -> bool:
    """Whether a trunk that others trained reads images in a network, or found the poses that it learned from."""
    searched = "hypotheses" in (config.method, method_before(config)) and isinstance(world, TwoStageWorld)
    return searched or any(isinstance(module, Trunk) for module in network.modules())


def _describe(spec: ModelSpec, config: RunConfig, commit: str, progress: TrainingProgress) -> None:
    """What a model was made by and from."""
    spec.recipe, spec.commit = json.dumps(to_portable(config)), commit
    spec.images_seen, spec.training_seconds = progress.all_images, progress.all_seconds


def _look_less(network: nn.Module, run: Path, config: RunConfig) -> None:
    if not isinstance(network, ObjectsNetwork):
        raise UsageError(f"--fast is for detectors of several objects, and {run} is of another kind; leave it out")
    if getattr(config.world, "photos", None) is None or not config.recipe.self_training:
        raise UsageError(
            f"--fast is for detectors that learned from photographs (curio-train linemod --photos), and {run} did not: "
            "the likeliest place of an object alone, which it looks at, is too often a wrong one; leave it out"
        )
    network.look_less()


def _golden(images: Tensor, graph: Graph, stable: Bool[Tensor, "batch slots"], outputs: Mapping[str, Tensor]) -> bytes:
    """The image with the most stable answers, and what onnxruntime made of it, by name, without a batch."""
    number = int(stable.sum(dim=1).argmax())
    unknown, answers = ~stable[number], dict[str, np.ndarray]()
    for name, values in outputs.items():
        if name not in graph.of_scene:
            answers[name] = values[number].numpy().copy()
            answers[name][unknown.numpy()] = np.nan
        elif not unknown.any():
            answers[name] = values[number].numpy()
    file = io.BytesIO()
    np.savez_compressed(file, allow_pickle=False, image=images[number].numpy(), **answers)
    return file.getvalue()


def _weights(half: bool, rounding_error: float) -> str:
    if not half:
        return "float32"
    return (
        "stored as float16, computed with in float32; answers that the last digits of an image do not decide differ by "
        f"at most {rounding_error:.2g} by that"
    )
