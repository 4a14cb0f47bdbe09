"""Marks a network's last stages in an exported graph, so that serving can run them alone where the place is known."""

import json
from collections.abc import Sequence
from dataclasses import asdict

import onnx
from torch import nn

from curio_train.export.onnx import Tracing, hide_outputs, put_metadata, to_onnx
from curio_train.networks.several_objects.network import ObjectsNetwork
from curio_train.networks.templates.network import TemplateNetwork
from curio_train.networks.two_stage.network import TwoStageNetwork
from curio_train.worlds.base import Camera


def stage_tensors(network: TwoStageNetwork) -> list[str]:
    """Names of the tensors that a traced graph of the network returns after its outputs."""
    return [name for note in network.stage_notes().values() for name in note.tensors.values()]


def traced(graph: nn.Module, network: nn.Module, camera: Camera, outputs: Sequence[str]) -> onnx.ModelProto:
    """Trace a graph; the tensors of its last stages keep their names inside, and the metadata says which they are.

    Args:
        graph: Returns the outputs, and of a two-stage network :func:`stage_tensors` after them.
        network: Of the graph.
        camera: Of its images.
        outputs: Their names.
    """
    if not isinstance(network, TwoStageNetwork):
        return to_onnx(graph, camera.width, camera.height, outputs, tracing_of(network))
    names = stage_tensors(network)
    model = to_onnx(graph, camera.width, camera.height, [*outputs, *names])
    hide_outputs(model, names)
    for key, note in network.stage_notes().items():
        put_metadata(model, key, json.dumps(asdict(note)))
    return model


def tracing_of(network: nn.Module) -> Tracing:
    """How a network is traced; of those with templates one image alone."""
    return Tracing(isinstance(network, ObjectsNetwork | TemplateNetwork), num_choosable(network))


def num_choosable(network: nn.Module) -> int | None:
    """How many slots a network has of which a caller may choose; None: it always answers all."""
    if not isinstance(network, ObjectsNetwork) or len(network.geometries) == 1:
        return None
    return len(network.geometries)
