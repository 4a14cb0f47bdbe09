"""Traces a run's graph in a process of its own while its weights are still being made.

Tracing takes one core about a minute for the thousands of nodes of template networks, and needs no weights: these are
put into the graph at the end.
"""

import multiprocessing
import signal
from multiprocessing.connection import Connection
from types import TracebackType

import onnx
import onnx_ir as ir
import torch

from curio_train.config import RunConfig
from curio_train.errors import CurioError
from curio_train.export.graph import Graph, deployable
from curio_train.export.onnx import simplified, traced_program
from curio_train.learning.state import TrainState
from curio_train.worlds import build


class TracingAhead:
    """A graph that another process traces within this context."""

    def __init__(self, config: RunConfig) -> None:
        """Begin nothing yet.

        Args:
            config: Of the run, from which the graph's structure follows.
        """
        self._config = config
        self._receiver: Connection | None = None

    def __enter__(self) -> "TracingAhead":
        context = multiprocessing.get_context("spawn")
        self._receiver, sender = context.Pipe(duplex=False)
        # A daemon ends with this process, however that ends.
        self._process = context.Process(target=_send_trace, args=(self._config, sender), daemon=True)
        self._process.start()
        sender.close()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._end()

    def model(self, graph: Graph) -> onnx.ModelProto | None:
        """The traced graph with the weights of another; None: it was not traced, for whatever reason.

        Args:
            graph: Of the same configuration, with the network as it is deployed.
        """
        if self._receiver is None:
            return None
        try:
            content = self._receiver.recv_bytes()
        except (EOFError, OSError):  # the second where it was ended while it sent
            return None
        self._process.join()  # where it is ended from here, it leaves a warning of Python's behind
        model = ir.from_proto(onnx.load_from_string(content))
        values = dict(graph.named_parameters()) | dict(graph.named_buffers())
        for name, initializer in model.graph.initializers.items():
            if name in values:
                initializer.const_value = ir.tensor(values[name].detach().numpy(), name=name)
        return simplified(model)

    def _end(self) -> None:
        if self._receiver is not None:
            self._receiver.close()
            self._process.terminate()
            self._process.join()
            self._receiver = None


def _send_trace(config: RunConfig, sender: Connection) -> None:
    """What the other process does. An error ends it without a word: the same is met again where it can be told."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to both; the first process ends this one
    torch.set_num_threads(1)
    try:
        world = build(config.world)
        network = deployable(TrainState(config, world, torch.device("cpu")).pose.network, half=False)
        graph = Graph(network, world)
        camera = world.camera
        with torch.no_grad():
            names = list(graph.outputs(torch.zeros(1, camera.height, camera.width, 3, dtype=torch.uint8)))
    except CurioError:
        return
    program = traced_program(graph, camera.width, camera.height, names)
    sender.send_bytes(program.model_proto.SerializeToString())
