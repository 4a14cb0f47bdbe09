"""A graph that reads one image, made into one that reads the images of a batch one after the other.

Template networks place crops and choose templates for each image by itself. Traced with a free batch, every one of
their thousands of operations carries its size along: tracing takes twice as long, and reading a batch takes longer than
reading its images. So such networks are traced for one image, and ONNX's Scan runs that graph on each image.
"""

import numpy as np
import onnx
from curio_serve.models.model import INPUT
from onnx import helper, numpy_helper

_BATCH, _NAME = "batch", "image_by_image"
_OF_ONE, _AXIS = "_of_one_image", "batch_axis"


def image_by_image(model: onnx.ModelProto) -> onnx.ModelProto:
    """The model for any number of images.

    Args:
        model: Its first input is one image, [1, height, width, 3]; other inputs are the same for all images. The first
            dimension of each output is 1.
    """
    graph = model.graph
    image, *others = graph.input
    shared = {one.name for one in others}
    body = onnx.GraphProto(name=_NAME)
    body.initializer.extend(one for one in graph.initializer if one.name not in shared)
    body.initializer.append(numpy_helper.from_array(np.array([0]), _AXIS))
    body.node.append(helper.make_node("Unsqueeze", [INPUT + _OF_ONE, _AXIS], [f"{INPUT}{_OF_ONE}_alone"]))
    body.input.append(_value(image, INPUT + _OF_ONE))
    for node in graph.node:
        body.node.append(node)
        body.node[-1].input[:] = [f"{INPUT}{_OF_ONE}_alone" if name == INPUT else name for name in node.input]
    for output in graph.output:
        body.node.append(helper.make_node("Squeeze", [output.name, _AXIS], [output.name + _OF_ONE]))
        body.output.append(_value(output, output.name + _OF_ONE))
    names = [output.name for output in graph.output]
    scan = helper.make_node("Scan", [INPUT], names, name=_NAME, body=body, num_scan_inputs=1)
    batched = onnx.ModelProto()
    batched.CopyFrom(model)
    del batched.graph.node[:], batched.graph.initializer[:]
    batched.graph.node.append(scan)
    batched.graph.initializer.extend(one for one in graph.initializer if one.name in shared)
    for value in (batched.graph.input[0], *batched.graph.output):
        value.type.tensor_type.shape.dim[0].dim_param = _BATCH
    return batched


def of_one_image(model: onnx.ModelProto) -> onnx.ModelProto:
    """The model that :func:`image_by_image` was given; any other model as it is."""
    body = inner_graph(model)
    if body is model.graph:
        return model
    single = onnx.ModelProto()
    single.CopyFrom(model)
    graph = single.graph
    del graph.node[:]
    first, last = 1, len(body.node) - len(body.output)
    for node in body.node[first:last]:
        graph.node.append(node)
        graph.node[-1].input[:] = [INPUT if name == f"{INPUT}{_OF_ONE}_alone" else name for name in node.input]
    graph.initializer.extend(one for one in body.initializer if one.name != _AXIS)
    for value in (graph.input[0], *graph.output):
        value.type.tensor_type.shape.dim[0].dim_value = 1
    return single


def inner_graph(model: onnx.ModelProto) -> onnx.GraphProto:
    """The graph that holds a model's operations and weights: its own, or that which Scan runs on each image."""
    first = model.graph.node[0]
    if first.op_type != "Scan":
        return model.graph
    (body,) = (attribute.g for attribute in first.attribute if attribute.name == "body")
    return body


def _value(like: onnx.ValueInfoProto, name: str) -> onnx.ValueInfoProto:
    """The description of a tensor without its first dimension."""
    value = onnx.ValueInfoProto()
    value.CopyFrom(like)
    value.name = name
    del value.type.tensor_type.shape.dim[0]
    return value
