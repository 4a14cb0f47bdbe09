"""A part of a model's graph that is run alone, so that a model whose last stages are used by themselves stays one file.

The exporter notes in the metadata between which tensors the graph can be cut.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from curio_proto.files.onnx_outline_pb2 import OnnxModel, OnnxValue

from curio_serve.errors import InternalError, ModelError
from curio_serve.models.runtime import open_session, runtime_errors

if TYPE_CHECKING:
    import onnxruntime

Array = np.ndarray
Note = TypeVar("Note")
_FLOAT32 = 1


def parse_note(kind: Callable[..., Note], text: str, is_valid: Callable[[Note], bool], where: str) -> Note:
    """Read what the exporter noted about a part of the graph.

    Args:
        kind: Makes it of its fields.
        text: JSON of the metadata.
        is_valid: Whether its values are possible; may raise TypeError or ValueError where they are of other types.
        where: The file and the metadata's key, for messages.

    Raises:
        ModelError: It is not one.
    """
    try:
        note = kind(**json.loads(text))
        if is_valid(note):
            return note
    except (ValueError, TypeError) as exc:
        raise ModelError(f"{where} in the metadata is not what curio-export writes: {exc}") from exc
    raise ModelError(f"{where} in the metadata has impossible values; export the model again")


class GraphPart:
    """The part of a graph between float32 tensors; safe to share between threads."""

    def __init__(
        self,
        data: bytes,
        tensors: Mapping[str, str],
        inputs: Sequence[str],
        outputs: Sequence[str],
        where: str,
        providers: Sequence[str],
    ) -> None:
        """Cut the graph; the runtime opens it when the part is first run.

        Args:
            data: Content of the ONNX file.
            tensors: Names in the graph of inputs and outputs.
            inputs: What the part is given.
            outputs: What it gives.
            where: The file and the metadata's key, for messages.
            providers: onnxruntime's names.

        Raises:
            ModelError: The graph has not these tensors.
        """
        self._inputs, self._outputs = (
            {name: tensors[name] for name in inputs},
            {name: tensors[name] for name in outputs},
        )
        self._where, self._providers = where, tuple(providers)
        self._graph = _cut(data, list(self._inputs.values()), list(self._outputs.values()), where)

    @cached_property
    def _session(self) -> "onnxruntime.InferenceSession":
        return open_session(self._graph, self._where, self._providers)

    def run(self, values: Mapping[str, Array]) -> dict[str, Array]:
        """Outputs by name.

        Args:
            values: Inputs by name, float32.

        Raises:
            InternalError: The runtime failed, or an output is not finite.
        """
        try:
            found = self._session.run(
                list(self._outputs.values()), {tensor: values[name] for name, tensor in self._inputs.items()}
            )
        except runtime_errors() as exc:
            raise InternalError(f"{self._where}: onnxruntime failed on crops of an image: {exc}") from exc
        if not all(np.isfinite(value).all() for value in found):
            raise InternalError(f"{self._where}: an output is not finite for this image")
        return dict(zip(self._outputs, found, strict=True))


def _cut(data: bytes, inputs: Sequence[str], outputs: Sequence[str], where: str) -> bytes:
    """The part of a graph between float32 tensors.

    Args:
        data: Content of the ONNX file.
        inputs: Tensors that the part is given.
        outputs: Tensors that it gives.
        where: The file and what names the tensors, for messages.

    Raises:
        ModelError: An output is none of the graph's tensors, or needs more than the inputs.
    """
    model = OnnxModel.FromString(data)
    graph = model.graph
    number_of = {name: number for number, node in enumerate(graph.node) for name in node.output}
    known = {*inputs, *(tensor.name for tensor in graph.initializer)}
    needed, pending = set[int](), list(outputs)
    while pending:
        name = pending.pop()
        if not name or name in known:
            continue
        if name not in number_of:
            raise ModelError(
                f"{where}: its outputs also depend on {name!r}, which is none of its inputs ({', '.join(inputs)}); "
                "export the model again"
            )
        if number_of[name] not in needed:
            needed.add(number_of[name])
            pending += graph.node[number_of[name]].input
    nodes = [graph.node[number] for number in sorted(needed)]
    used = {name for node in nodes for name in node.input}
    initializers = [tensor for tensor in graph.initializer if tensor.name in used]
    part = OnnxModel()
    part.CopyFrom(model)
    for field in ("node", "initializer", "sparse_initializer", "input", "output"):
        part.graph.ClearField(field)
    part.graph.node.extend(nodes)
    part.graph.initializer.extend(initializers)
    part.graph.input.extend(map(_float, inputs))
    part.graph.output.extend(map(_float, outputs))
    return part.SerializeToString()


def _float(name: str) -> OnnxValue:
    value = OnnxValue(name=name)
    value.type.tensor_type.elem_type = _FLOAT32
    return value
