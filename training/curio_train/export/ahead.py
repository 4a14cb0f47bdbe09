"""Traces a run's graph in a process of its own while its weights are still being made.

Tracing takes one core about a minute for the thousands of nodes of template networks, and needs no weights: these are
put into the graph at the end.
"""

import onnx
import onnx_ir as ir
import torch

from curio_train.config import RunConfig
from curio_train.export.graph import Graph, deployable
from curio_train.export.onnx import simplified, traced_program
from curio_train.export.stages import tracing_of
from curio_train.learning.state import TrainState
from curio_train.second_process import SecondProcess
from curio_train.worlds import build


class TracingAhead(SecondProcess[bytes]):
    """A graph that another process traces within this context."""

    def __init__(self, config: RunConfig) -> None:
        """Begin nothing yet.

        Args:
            config: Of the run, from which the graph's structure follows.
        """
        super().__init__(_trace, config)

    def model(self, graph: Graph) -> onnx.ModelProto | None:
        """The traced graph with the weights of another; None: it was not traced, for whatever reason.

        Args:
            graph: Of the same configuration, with the network as it is deployed.
        """
        content = self.result
        if not isinstance(content, bytes):
            return None  # the same error is met again where it can be told
        model = ir.from_proto(onnx.load_from_string(content))
        values = dict(graph.named_parameters()) | dict(graph.named_buffers())
        for name, initializer in model.graph.initializers.items():
            if name in values:
                initializer.const_value = ir.tensor(values[name].detach().numpy(), name=name)
        return simplified(model, tracing_of(graph.network))


def _trace(config: RunConfig) -> bytes:
    world = build(config.world)
    network = deployable(TrainState(config, world, torch.device("cpu")).pose.network, half=False)
    graph = Graph(network, world)
    camera = world.camera
    with torch.no_grad():
        names = list(graph.outputs(torch.zeros(1, camera.height, camera.width, 3, dtype=torch.uint8)))
    program = traced_program(graph, camera.width, camera.height, names, tracing_of(network))
    content: bytes = program.model_proto.SerializeToString()
    return content
