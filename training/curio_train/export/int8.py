"""Quantises an exported graph: int8 convolutions by onnxruntime's own quantiser, as QDQ nodes.

Weights have a scale a channel and seven bits, so that sums never saturate and processors with and without VNNI compute
the same. Activations and sums of residual blocks stay in int8 between convolutions. Convolutions whose output is the
input of no activation and no other convolution give the answer itself and stay in float32, as the first ones do, those
that add few products, and all else.
"""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import numpy as np
import onnx
from curio_serve.models.model import INPUT
from curio_serve.models.runtime import load_onnxruntime
from onnx import helper, numpy_helper
from torch import Tensor

from curio_train.errors import ExportError
from curio_train.export.image_by_image import image_by_image, inner_graph, of_one_image
from curio_train.export.onnx import quiet

_ACTIVATIONS = ("Relu", "Clip")
_BETWEEN = (*_ACTIVATIONS, "Add")  # that stay in int8 after a convolution
_LEAST_PRODUCTS = 256  # in each sum of a convolution; with fewer, eight bits save little, and rounding tells more
_FACTOR = "rounding"
_WARNINGS, _ERRORS = 2, 3  # severities of onnxruntime
_ROUNDING = (1e-7, -1e-7, 2e-7, -2e-7, 3e-7, -3e-7)  # relative: that of float32 in a few operations


def to_int8(model: onnx.ModelProto, images: Tensor) -> onnx.ModelProto:
    """The model with convolutions that compute in int8.

    Args:
        model: In float32; stays as it is.
        images: For the ranges of the activations, uint8 [num_images, 3, height, width].

    Raises:
        ExportError: There is no convolution to quantise.
    """
    runtime = load_onnxruntime()  # first, because it turns telemetry off
    from onnxruntime import quantization

    single = of_one_image(model)
    kept = _kept(single.graph)
    if not any(node.op_type == "Conv" and node.name not in kept for node in single.graph.node):
        raise ExportError(
            f"the network has no convolution of {_LEAST_PRODUCTS} or more products before an activation to quantise; "
            "export without --int8"
        )

    class Reader(quantization.CalibrationDataReader):
        def __init__(self) -> None:
            # One at a time: eight images of eight objects take more memory than most machines have.
            self._feeds = iter(images.permute(0, 2, 3, 1).contiguous().numpy()[:, None])

        def get_next(self) -> dict[str, np.ndarray] | None:
            batch = next(self._feeds, None)
            return None if batch is None else {INPUT: batch}

    # The quantiser advises to preprocess, which folded graphs do not need, and its sessions to fold wanted slots away.
    with tempfile.TemporaryDirectory() as folder, quiet(""), _errors_alone(runtime):
        source, target = Path(folder) / "float32.onnx", Path(folder) / "int8.onnx"
        onnx.save(single, source)  # of a model in memory the quantiser takes the weights away
        quantization.quantize_static(
            source,
            target,
            Reader(),
            quant_format=quantization.QuantFormat.QDQ,
            op_types_to_quantize=["Conv", *_BETWEEN],
            nodes_to_exclude=sorted(kept),
            per_channel=True,
            reduce_range=True,
            activation_type=quantization.QuantType.QUInt8,
            weight_type=quantization.QuantType.QInt8,
        )
        quantised = onnx.load(target)
    if single is not model:
        quantised = image_by_image(quantised)
    onnx.checker.check_model(quantised)
    return quantised


@contextmanager
def _errors_alone(runtime: ModuleType) -> Iterator[None]:
    runtime.set_default_logger_severity(_ERRORS)
    try:
        yield
    finally:
        runtime.set_default_logger_severity(_WARNINGS)  # which is onnxruntime's default


def rounded_otherwise(model: onnx.ModelProto) -> Iterator[onnx.ModelProto]:
    """A quantised model as it computes on processors that round float32 in another way.

    A value between two steps of eight bits falls to either by its last digit, and what follows differs by a whole step.
    So what float32 operations compute is made larger or smaller by about their rounding before it is quantised.
    """
    for fraction in _ROUNDING:
        other = onnx.ModelProto()
        other.CopyFrom(model)
        graph, nodes, rounded = inner_graph(other), list[onnx.NodeProto](), set[str]()
        in_int8 = {name for node in graph.node if node.op_type == "DequantizeLinear" for name in node.output}
        made_by = {name: node for node in graph.node for name in node.output}
        graph.initializer.append(numpy_helper.from_array(np.array(1 + fraction, np.float32), _FACTOR))
        for node in graph.node:
            exact = node.input[0] if node.op_type == "QuantizeLinear" else ""
            if exact in made_by and in_int8.isdisjoint(made_by[exact].input):
                node.input[0] = f"{exact}_rounded"
                if exact not in rounded:
                    nodes.append(helper.make_node("Mul", [exact, _FACTOR], [node.input[0]], name=f"{exact}_rounding"))
                    rounded.add(exact)
            nodes.append(node)
        del graph.node[:]
        graph.node.extend(nodes)
        yield other


def _kept(graph: onnx.GraphProto) -> set[str]:
    """Names of the nodes that stay in float32.

    Those are the first convolutions, because many pixels lie right between two steps of eight bits, where rounding
    decides; convolutions that no activation and no other convolution follows, at once or after the sum of a residual
    block, whose weights the graph computes, or whose sums have few products; and activations and sums that follow no
    quantised convolution.
    """
    products = {tensor.name: np.prod(tensor.dims[1:]) for tensor in graph.initializer}
    followed: set[str] = set()
    for node in reversed(graph.node):  # which are in the order of computation
        if node.op_type in _ACTIVATIONS or (node.op_type == "Add" and node.output[0] in followed):
            followed.update(node.input)
        elif node.op_type == "Conv":
            followed.add(node.input[0])
    kept, quantised, convolved = set[str](), set[str](), set[str]()
    for node in graph.node:
        is_inner = node.input and node.input[0] in convolved and node.output[0] in followed
        is_large = node.op_type == "Conv" and products.get(node.input[1], 0) >= _LEAST_PRODUCTS
        if is_large and is_inner:
            quantised.add(node.output[0])
        elif node.op_type == "Conv" or (node.op_type in _BETWEEN and quantised.isdisjoint(node.input)):
            kept.add(node.name)
        if node.op_type == "Conv" or (node.op_type in _BETWEEN and not convolved.isdisjoint(node.input)):
            convolved.add(node.output[0])
    return kept
