"""The graph that is exported: encoder and heads alone, and which of its answers rounding does not decide."""

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool
from torch import Tensor, nn

from curio_train.counting import counted
from curio_train.errors import ExportError
from curio_train.export.parity import LARGEST_PARITY_ERROR
from curio_train.export.stages import stage_tensors
from curio_train.networks.layers import fold_batch_norm
from curio_train.networks.templates.trunk import Trunk
from curio_train.networks.two_stage.network import TwoStageNetwork
from curio_train.scene_code import COLOR, CONFIDENCE, TRANSLATION, joined
from curio_train.threads import in_threads
from curio_train.worlds.base import World
from curio_train.worlds.several_objects.scenes import ObjectScenes
from curio_train.worlds.single_object.world import SingleObjectWorld

NUM_JITTERED = 8
"""Rounds of jitter in the check of numerical stability; it misses a tie once in 2 to the power of this."""

_NUM_CHECK_IMAGES = 4  # of either kind
_IMAGES_AT_ONCE = 2  # that torch reads: eight images of eight objects take 13 GB
_ROUNDS_AT_ONCE = 2  # of jitter, each of one image at a time
_CHECK_SEED = 20_210
_PIXEL_JITTER = 3e-6  # standard deviation of pixels from 0 to 1: fifty times their rounding
_LAYER_JITTER = 1e-6  # of what a layer says, relative: ten times its rounding, so that a runtime's own order is within
_TRUNK_JITTER = 2.5e-5  # of what the quick trunk says: what such jitter of its layers adds up to
_NUM_NOISE = 1_000_003  # drawn values of jitter, shifted and repeated: drawing as many as layers have takes minutes
_LEAST_STABLE = 0.25  # of the answers to check images
_MOST_DRAWS = 4  # of check images, where too few answers are stable
TRAIN_ON = (
    "Training has diverged, or hardly begun: then go on with it, by curio-train with --resume and more --images or "
    "--minutes"
)
"""What to do about a network whose answers are not stable."""


class Graph(nn.Module):
    """The module that is traced: it takes a camera's pixels and returns physical quantities."""

    of_scene: frozenset[str]
    """Names of outputs that a scene has once, not each object."""

    def __init__(self, network: nn.Module, world: World) -> None:
        super().__init__()
        self.network = network
        self.of_scene = frozenset(field.name for field in world.outputs.fields if not field.per_object)
        self._outputs = world.outputs
        # Not while it is traced: the notes of stages hold numbers, which a trace would read out of its weights.
        self._stage_tensors = stage_tensors(network) if isinstance(network, TwoStageNetwork) else []
        self.eval()

    def forward(self, image: Tensor, slots: Tensor | None = None) -> tuple[Tensor, ...]:
        """The outputs, of the wanted slots alone if given, then the tensors of the last stages, if it has such."""
        outputs = self._outputs
        if isinstance(self.network, TwoStageNetwork):
            code, stages = self.network.with_stages(pixels_of(image))
            return (*outputs.from_code(code).values(), *(stages[name] for name in self._stage_tensors))
        if slots is None:
            return tuple(outputs.from_code(self.network(pixels_of(image))).values())
        return tuple(outputs.of_slots(slots).from_code(self.network(pixels_of(image), slots)).values())

    def outputs(self, image: Tensor) -> dict[str, Tensor]:
        """Outputs by name, for uint8 images [batch, height, width, 3]."""
        return self.read(pixels_of(image))

    def read(self, pixels: Tensor) -> dict[str, Tensor]:
        """Outputs by name, for pixels [batch, 3, height, width] in [0, 1]."""
        return self._outputs.from_code(self.network(pixels))

    def in_parts(self, pixels: Tensor, num_at_once: int = _IMAGES_AT_ONCE) -> dict[str, Tensor]:
        """What :meth:`read` returns, computed for few images at once."""
        return joined([self.read(part) for part in pixels.split(num_at_once)])

    def judged(self, outputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Outputs as they are compared: positions are those of middles; a distant origin moves with every rounding."""
        return self._outputs.at_middles(outputs)

    def where(self, stable: Bool[Tensor, "batch slots"], outputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The stable answers as they are compared, one a row: of objects, or of scenes whose every answer is stable."""
        whole = stable.all(dim=1)
        compared = self.judged(outputs).items()
        return {name: values[whole if name in self.of_scene else stable] for name, values in compared}

    def unmoved(
        self, outputs: Mapping[str, Tensor], others: Mapping[str, Tensor], largest: float = LARGEST_PARITY_ERROR
    ) -> Bool[Tensor, "batch slots"]:
        """Which answers are the same in both, up to ``largest``; what a scene has once moves all of its answers."""
        outputs, others = self.judged(outputs), self.judged(others)
        same = torch.ones(outputs[TRANSLATION].shape[:2], dtype=torch.bool)
        for name, values in outputs.items():
            kept = 1 if name in self.of_scene else 2
            moved = (values - others[name]).abs().reshape(*values.shape[:kept], -1).amax(dim=-1)
            same &= moved.reshape(len(same), -1) <= largest
        return same


def pixels_of(image: Tensor) -> Tensor:
    """Pixels [batch, 3, height, width] in [0, 1] of uint8 images [batch, height, width, 3]."""
    return image.permute(0, 3, 1, 2).float() / 255


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
def check_images(world: World, number: int = 0) -> Tensor:
    """Images that torch and onnxruntime have to agree on, uint8 [batch, height, width, 3]: over black, then over noise.

    Parts without colours of their own have the most typical one. The noise is smooth and never without objects: a
    two-stage network that moves by the last digit sees something else between white pixels, and where nothing is to be
    found the last digit decides between places that are equally unlikely.

    Args:
        world: Whose objects they show.
        number: Of the draw.
    """
    code = world.sample(_NUM_CHECK_IMAGES, (_CHECK_SEED + number,))
    if isinstance(world, SingleObjectWorld) and world.object.unpainted:
        code[COLOR] = torch.tensor(world.object.typical_color).expand_as(code[COLOR])  # templates know no other
    if isinstance(world, ObjectScenes):
        code[CONFIDENCE] = torch.ones_like(code[CONFIDENCE])  # each is there
    size = (world.camera.height, world.camera.width)
    random = np.random.default_rng((_CHECK_SEED + number,))
    coarse = random.random((_NUM_CHECK_IMAGES, 3, *(side // 8 for side in size)))
    noise = F.interpolate(torch.from_numpy(coarse).float(), size, mode="bilinear")
    images = torch.cat([world.render(code).cpu(), world.render(code, noise).cpu()]).clamp(0, 1)
    return (images * 255).round().byte().permute(0, 2, 3, 1).contiguous()


def decided_images(graph: Graph, world: World, advice: str = TRAIN_ON) -> tuple[Tensor, Bool[Tensor, "batch slots"]]:
    """Check images, and which answers to them can tell whether a runtime computes the same.

    Where too few can, more images are drawn, and those with most such answers taken: alignment steps enlarge what
    rounding changes, most of all where an object looks unlike its templates.

    Args:
        graph: The network that is exported.
        world: Whose objects images show.
        advice: What to do where too few can, for the error.

    Raises:
        ExportError: Too few can.
    """
    images = check_images(world)
    num, stable = len(images), numerically_stable(graph, images)
    for number in range(1, _MOST_DRAWS):
        if stable.float().mean() >= _LEAST_STABLE:
            break
        others = check_images(world, number)
        images, stable = torch.cat([images, others]), torch.cat([stable, numerically_stable(graph, others)])
        best = stable.sum(dim=1).argsort(descending=True, stable=True)[:num]
        images, stable = images[best], stable[best]
    if stable.float().mean() < _LEAST_STABLE:
        raise ExportError(
            f"{int((~stable).sum())} of the network's {stable.numel()} answers to check images change with the images' "
            f"last digits or are not finite; nothing was written. {advice}"
        )
    return images, stable


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
    """
    pixels = pixels_of(images)
    answers = graph.in_parts(pixels)

    def unmoved(number: int) -> Tensor:
        generator = torch.Generator().manual_seed(_CHECK_SEED + number)
        jittered = pixels + _PIXEL_JITTER * torch.randn(pixels.shape, generator=generator)
        return graph.unmoved(answers, _with_jittered_layers(graph, generator).in_parts(jittered, 1))

    rounds = in_threads(unmoved, range(NUM_JITTERED), _ROUNDS_AT_ONCE)
    return torch.stack(list(counted(rounds, NUM_JITTERED, "checking what rounding changes, rounds"))).all(dim=0)


def _with_jittered_layers(graph: Graph, generator: torch.Generator) -> Graph:
    """A copy whose every layer's output is jittered by about as much as another order of rounding changes it."""
    noise = torch.randn(_NUM_NOISE, generator=generator)
    repeated, graph = noise, copy.deepcopy(graph)

    def jittered(output: Tensor, deviation: float) -> Tensor:
        nonlocal repeated
        first = int(torch.randint(_NUM_NOISE, (1,), generator=generator))
        if len(repeated) < _NUM_NOISE + output.numel():
            repeated = noise.repeat(1 + -(-output.numel() // _NUM_NOISE))
        # In the order in which the output's values lie in memory: mixed orders take several times as long.
        ordered = torch.empty_like(output).stride()
        return torch.addcmul(output, output, repeated.as_strided(output.shape, ordered, first), value=deviation)

    def off(layer: nn.Module, _given: object, output: Any) -> object:
        if isinstance(layer, Trunk):  # which onnxruntime computes
            return tuple(jittered(features, _TRUNK_JITTER) for features in output)
        # What is no tensor are poses, which are no layer's.
        return jittered(output, _LAYER_JITTER) if isinstance(output, Tensor) else output

    for layer in graph.network.modules():
        in_one = isinstance(layer, Trunk) and layer.quick is not None
        if layer is not graph.network and (in_one or not list(layer.children())):
            layer.register_forward_hook(off)
    return graph
