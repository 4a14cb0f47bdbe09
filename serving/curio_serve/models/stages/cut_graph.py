"""Cuts a part out of a model's graph, so that a model whose parts are used alone stays one file."""

from collections.abc import Sequence

from curio_proto.files.onnx_outline_pb2 import OnnxModel, OnnxValue

from curio_serve.errors import ModelError

_FLOAT32 = 1


def cut_graph(data: bytes, inputs: Sequence[str], outputs: Sequence[str], where: str) -> bytes:
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
            raise ModelError(f"{where} names tensors that need {name!r} beside {', '.join(inputs)}")
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
