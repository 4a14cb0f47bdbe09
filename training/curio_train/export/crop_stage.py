"""Marks the crop-pose stage in an exported graph, so that serving can run it alone where the place is known."""

import json
from collections.abc import Sequence
from dataclasses import asdict

import onnx
from curio_serve.models.stages.crop_stage import CROP_STAGE_KEY, INPUT, OUTPUTS
from torch import nn

from curio_train.export.onnx import hide_outputs, put_metadata, to_onnx
from curio_train.networks.several_objects.network import ObjectsNetwork
from curio_train.networks.two_stage.network import TwoStageNetwork
from curio_train.worlds.base import Camera

STAGE_TENSORS = (INPUT, *OUTPUTS)
"""What a graph of a two-stage network returns after its outputs while it is traced."""

_PREFIX = "crop_stage."


def traced(graph: nn.Module, network: nn.Module, camera: Camera, outputs: Sequence[str]) -> onnx.ModelProto:
    """Trace a graph; the tensors of its crop-pose stage keep their names inside, and the metadata says which they are.

    Args:
        graph: Returns the outputs, and of a two-stage network :data:`STAGE_TENSORS` after them.
        network: Of the graph.
        camera: Of its images.
        outputs: Their names.
    """
    if not isinstance(network, TwoStageNetwork):
        return to_onnx(graph, camera.width, camera.height, outputs, num_choosable(network))
    names = {name: _PREFIX + name for name in STAGE_TENSORS}
    model = to_onnx(graph, camera.width, camera.height, [*outputs, *names.values()])
    hide_outputs(model, names.values())
    put_metadata(model, CROP_STAGE_KEY, json.dumps(asdict(network.crop_stage_note(names))))
    return model


def num_choosable(network: nn.Module) -> int | None:
    """How many slots a network has of which a caller may choose; None: it always answers all."""
    if not isinstance(network, ObjectsNetwork) or len(network.geometries) == 1:
        return None
    return len(network.geometries)
