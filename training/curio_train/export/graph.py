"""From a run to a model that any runtime can serve: encoder and heads alone, checked against the trained network."""

import copy
import io
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
import torch
import torch.nn.functional as F
from curio_proto.v1.model_spec_pb2 import ModelSpec
from curio_serve.models.golden import GOLDEN_FILE
from curio_serve.models.model_folder import MODEL_FILE
from jaxtyping import Bool
from torch import Tensor, nn

from curio_train.config import RunConfig
from curio_train.errors import ExportError, UsageError
from curio_train.export.card import Provenance, card
from curio_train.export.crop_stage import STAGE_TENSORS, traced
from curio_train.export.folder import ModelFolder, triton_config
from curio_train.export.int8 import rounded_otherwise
from curio_train.export.onnx import put_spec, store_half
from curio_train.export.parity import LARGEST_PARITY_ERROR, largest_difference, refuse_disparity
from curio_train.export.spec import model_spec
from curio_train.exported_model import WEIGHTS_FILE, ExportedModel
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.learning.runs.configuration import to_portable
from curio_train.learning.runs.initial import method_before, weights_file
from curio_train.learning.runs.provenance import run_sessions
from curio_train.learning.state import TrainingProgress
from curio_train.networks.layers import fold_batch_norm
from curio_train.networks.several_objects.network import ObjectsNetwork
from curio_train.networks.templates.quick_trunk import with_quick_trunk
from curio_train.networks.templates.trunk import Trunk
from curio_train.networks.two_stage.network import TwoStageNetwork
from curio_train.scene_code import TRANSLATION, joined
from curio_train.worlds import build
from curio_train.worlds.base import World
from curio_train.worlds.single_object.two_stage import TwoStageWorld

NUM_JITTERED = 12
"""Rounds of jitter in the check of numerical stability; it misses a tie once in 2 to the power of this."""

_NUM_CHECK_IMAGES = 4  # of either kind
_IMAGES_AT_ONCE = 2  # that torch reads: eight images of eight objects take 13 GB
_CHECK_SEED = (20_210,)
_PIXEL_JITTER = 3e-6  # standard deviation of pixels from 0 to 1: fifty times their rounding
_LAYER_JITTER = 1e-6  # of what a layer says, relative: ten times its rounding, so that a runtime's own order is within
_NUM_NOISE = 1_000_003  # drawn values of jitter, shifted and repeated: drawing as many as layers have takes minutes
_FAST = "; looks at each object in one crop a pass (--fast), which the confidence was not calibrated for"
_LEAST_STABLE = 0.25  # of the answers to check images
_LARGEST_STEP = 5e-4  # that rounding may move an answer in int8 by: half of what servers let golden answers differ by


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
    """Largest absolute difference between what was written and the network that was trained; 0 in float32."""
    num_bytes: int
    """Of model.onnx."""
    weights: str
    """How weights are stored, and what that costs."""


class Graph(nn.Module):
    """The module that is traced: it takes a camera's pixels and returns physical quantities."""

    of_scene: frozenset[str]
    """Names of outputs that a scene has once, not each object."""

    def __init__(self, network: nn.Module, world: World) -> None:
        super().__init__()
        self.network = network
        self.of_scene = frozenset(field.name for field in world.outputs.fields if not field.per_object)
        self._world = world
        self.eval()

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        """The outputs, then the tensors of the crop-pose stage, if the network has one."""
        if not isinstance(self.network, TwoStageNetwork):
            return tuple(self.outputs(image).values())
        code, stage = self.network.with_crop_stage(_pixels(image))
        return (*self._world.outputs.from_code(code).values(), *(stage[name] for name in STAGE_TENSORS))

    def outputs(self, image: Tensor) -> dict[str, Tensor]:
        """Outputs by name, for uint8 images [batch, height, width, 3]."""
        return self.read(_pixels(image))

    def read(self, pixels: Tensor) -> dict[str, Tensor]:
        """Outputs by name, for pixels [batch, 3, height, width] in [0, 1]."""
        return self._world.outputs.from_code(self.network(pixels))

    def in_parts(self, pixels: Tensor) -> dict[str, Tensor]:
        """The same, few images at once."""
        return joined([self.read(part) for part in pixels.split(_IMAGES_AT_ONCE)])

    def where(self, stable: Bool[Tensor, "batch slots"], outputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The stable answers, one a row: of objects, or of scenes whose every answer is stable."""
        whole = stable.all(dim=1)
        return {name: values[whole if name in self.of_scene else stable] for name, values in outputs.items()}

    def unmoved(
        self, outputs: Mapping[str, Tensor], others: Mapping[str, Tensor], largest: float = LARGEST_PARITY_ERROR
    ) -> Bool[Tensor, "batch slots"]:
        """Which answers are the same in both, up to ``largest``; what a scene has once moves all of its answers."""
        same = torch.ones(outputs[TRANSLATION].shape[:2], dtype=torch.bool)
        for name, values in outputs.items():
            kept = 1 if name in self.of_scene else 2
            moved = (values - others[name]).abs().reshape(*values.shape[:kept], -1).amax(dim=-1)
            same &= moved.reshape(len(same), -1) <= largest
        return same


def _pixels(image: Tensor) -> Tensor:
    return image.permute(0, 3, 1, 2).float() / 255


def export(
    run: Path,
    out: Path,
    name: str | None = None,
    *,
    half: bool = False,
    fast: bool = False,
    reduce: Reduce | None = None,
    ahead: Callable[[Graph], onnx.ModelProto | None] = lambda graph: None,
) -> Exported:
    """Write the network of a run as the next version of a model.

    Args:
        run: The run folder. Its training images are not needed.
        out: Folder of models.
        name: Of the model; the world's choice unless given (a LineMOD model is named after its class).
        half: Store weights as float16, half as large; they are computed with in float32.
        fast: Let a detector for several objects look at each in one crop a pass.
        reduce: Applied to the float32 graph once that agrees with torch; stores the rest as ``half`` says.
        ahead: Gives the traced graph, where it has been traced before; not together with ``half``.

    Raises:
        UsageError: The name cannot be a model's, the folder is something else, or the network cannot be faster.
        CheckpointError: The run is missing, damaged or without a checkpoint.
        ExportError: torch and onnxruntime disagree, ``reduce`` costs too much, or the model cannot be written; nothing
            is left behind.
    """
    folder = RunFolder.open(run)
    world = build(folder.config.world)
    target = ModelFolder.named(out, world.model_name if name is None else name)
    state = folder.trained(world)
    if fast:
        _look_less(state.pose.network, run)
    trained = Graph(state.pose.network, world)
    deployed = Graph(deployable(state.pose.network, half), world)
    images = check_images(world)
    with torch.no_grad():
        learned = trained.in_parts(_pixels(images))
        expected = deployed.in_parts(_pixels(images)) if half else learned
    rounding_error = largest_difference(learned, expected) if half else 0.0

    shapes = {name: tuple(values.shape[1:]) for name, values in expected.items()}
    config = triton_config(target.path.name, tuple(images.shape[1:]), shapes)
    target.refuse_other_tensors(config)
    checked = with_quick_trunk(deployed.network if half else trained.network)
    stable = numerically_stable(Graph(checked, world), images)

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
        stable &= _unmoved_by_rounding(deployed, model, images, found)
        rounding_error = largest_difference(deployed.where(stable, learned), deployed.where(stable, found))
    spec.parity_max_abs_error = parity_error if reduce is None else rounding_error
    put_spec(model, spec)
    version = target.next_version()
    pretrained = _uses_pretrained(state.pose.network, world, folder.config)
    made = Provenance(run, folder.config, sessions, state.progress, weights + _FAST * fast, pretrained)
    text = card(version, spec, shapes, world.objects, made)
    files = {
        MODEL_FILE: model.SerializeToString(),
        GOLDEN_FILE: _golden(images, deployed, stable, found),
        WEIGHTS_FILE: weights_file(state, folder.config, half=half),
    }
    return Exported(target.add(version, files, config, text), parity_error, rounding_error, model.ByteSize(), weights)


def _unmoved_by_rounding(graph: Graph, model: onnx.ModelProto, images: Tensor, found: Mapping[str, Tensor]) -> Tensor:
    """Which answers of a reduced graph stay where processors round in another way, [batch, slots]."""
    others = [ExportedModel(other.SerializeToString(), "its check")(images) for other in rounded_otherwise(model)]
    unmoved = torch.stack([graph.unmoved(found, other, _LARGEST_STEP) for other in others]).all(dim=0)
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


def _look_less(network: nn.Module, run: Path) -> None:
    if not isinstance(network, ObjectsNetwork):
        raise UsageError(f"--fast is for detectors of several objects, and {run} is of another kind; leave it out")
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
    return f"stored as float16, computed with in float32; outputs differ by at most {rounding_error:.2g} by that"


def deployable(network: nn.Module, half: bool) -> nn.Module:
    """The network as it is deployed: batch norm folded into the convolutions, weights rounded as they are stored."""
    network = copy.deepcopy(network).eval()
    fold_batch_norm(network)
    if half:
        for parameter in network.parameters():
            parameter.data = parameter.data.half().float()
            if not parameter.isfinite().all():
                raise ExportError("a weight is too large for float16; export without --half")
    return network


@torch.no_grad()
def check_images(world: World) -> Tensor:
    """Images that torch and onnxruntime have to agree on, uint8 [batch, height, width, 3]: over black, then over noise.

    The noise is smooth and never without objects: a two-stage network that moves by the last digit sees something else
    between white pixels, and where nothing is to be found the last digit decides between places that are equally
    unlikely.
    """
    code = world.sample(_NUM_CHECK_IMAGES, _CHECK_SEED)
    size = (world.camera.height, world.camera.width)
    coarse = np.random.default_rng(_CHECK_SEED).random((_NUM_CHECK_IMAGES, 3, *(side // 8 for side in size)))
    noise = F.interpolate(torch.from_numpy(coarse).float(), size, mode="bilinear")
    images = torch.cat([world.render(code).cpu(), world.render(code, noise).cpu()]).clamp(0, 1)
    return (images * 255).round().byte().permute(0, 2, 3, 1).contiguous()


@torch.no_grad()
def numerically_stable(graph: Graph, images: Tensor) -> Bool[Tensor, "batch slots"]:
    """Which answers can tell whether a runtime computes the same: the last digits of an image do not move them.

    Where the answer is a choice among equals (the likeliest cell, say, of a network that has learned next to nothing,
    or the place of an object that is not there), rounding decides, and torch differs from itself on another machine. It
    rounds in every layer, and cells that read the same pixels almost alike are moved together by these: so layers are
    jittered, too.

    Args:
        graph: The network that is exported.
        images: uint8 [batch, height, width, 3].

    Raises:
        ExportError: Too few can.
    """
    pixels, generator = _pixels(images), torch.Generator().manual_seed(*_CHECK_SEED)
    answers = graph.in_parts(pixels)
    stable = torch.ones(answers[TRANSLATION].shape[:2], dtype=torch.bool)
    with _jittered_layers(graph.network, generator):
        for _ in range(NUM_JITTERED):
            jittered = graph.in_parts(pixels + _PIXEL_JITTER * torch.randn(pixels.shape, generator=generator))
            stable &= graph.unmoved(answers, jittered)
    if stable.float().mean() < _LEAST_STABLE:
        raise ExportError(
            f"{int((~stable).sum())} of the network's {stable.numel()} answers to check images change with the images' "
            "last digits or are not finite; nothing was written. Has the training diverged, or hardly begun?"
        )
    return stable


@contextmanager
def _jittered_layers(network: nn.Module, generator: torch.Generator) -> Iterator[None]:
    """Within the block every layer's output is jittered by about as much as another order of rounding changes it."""
    noise = _LAYER_JITTER * torch.randn(_NUM_NOISE, generator=generator)
    repeated = noise

    def off(_layer: nn.Module, _given: object, output: Tensor) -> Tensor:
        nonlocal repeated
        first = int(torch.randint(_NUM_NOISE, (1,), generator=generator))
        if len(repeated) < _NUM_NOISE + output.numel():
            repeated = noise.repeat(1 + -(-output.numel() // _NUM_NOISE))
        # In the order in which the output's values lie in memory: mixed orders take several times as long.
        ordered = torch.empty_like(output).stride()
        return torch.addcmul(output, output, repeated.as_strided(output.shape, ordered, first))

    layers = [module for module in network.modules() if module is not network and not list(module.children())]
    hooks = [layer.register_forward_hook(off) for layer in layers]
    try:
        yield
    finally:
        for hook in hooks:
            hook.remove()
