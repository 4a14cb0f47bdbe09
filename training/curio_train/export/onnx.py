"""Writes a torch module as an ONNX file."""

import gc
import logging
import warnings
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import onnx
import onnx_ir as ir
import torch
from curio_proto.v1.model_spec_pb2 import ModelSpec
from curio_serve.models.model import INPUT, SLOTS
from curio_serve.models.spec import SPEC_KEY
from google.protobuf import json_format
from onnx import TensorProto, helper, numpy_helper
from onnx_ir.passes import common as passes
from onnxscript import optimizer, rewriter
from onnxscript.rewriter.rules.common import materialize_reshape_shape_rule
from torch import nn

from curio_train.export.image_by_image import image_by_image, inner_graph

OPSET = 18
_TALKATIVE = "torch.onnx", "onnx_ir"  # loggers: of packages that are not needed and constants that stay
_LARGEST_REPEATED = 1 << 20  # values; larger constants are weights, which are there once
_MOVING = ("Reshape", "Slice", "Transpose")  # which make no more of a weight than there is
_SMALLEST_HALF = 256  # values; below, a Cast costs more than it saves


class Tracing(NamedTuple):
    """How a network is traced."""

    one_image: bool = False
    """Whether it is traced for one image, to be run on each of a batch, see :mod:`curio_train.export.image_by_image`.
    """
    num_slots: int | None = None
    """Number of slots, of a network that also takes the wanted slots' numbers, int64 [wanted]; None: it does not."""


_PLAIN = Tracing()


def to_onnx(
    network: nn.Module, width: int, height: int, outputs: Sequence[str], tracing: Tracing = _PLAIN
) -> onnx.ModelProto:
    """Trace a network into an ONNX model with a free batch, and simplify it.

    Args:
        network: See :func:`traced_program`.
        width: Of the images, pixels.
        height: Of the images, pixels.
        outputs: Names of the returned tensors, in order.
        tracing: See :class:`Tracing`.

    Returns:
        A model that holds its weights and nothing of the machine it was traced on.
    """
    return simplified(traced_program(network, width, height, outputs, tracing).model, tracing)


def traced_program(
    network: nn.Module, width: int, height: int, outputs: Sequence[str], tracing: Tracing
) -> torch.onnx.ONNXProgram:
    """Trace a network; weights keep their names in its graph.

    Args:
        network: Takes uint8 RGB [batch, height, width, 3], returns a tuple of tensors.
        width: Of the images, pixels.
        height: Of the images, pixels.
        outputs: Names of the returned tensors, in order.
        tracing: See :class:`Tracing`.

    Returns:
        What :func:`simplified` makes a model of.
    """
    num_images = 1 if tracing.one_image else 2
    examples: tuple[torch.Tensor, ...] = (torch.zeros(num_images, height, width, 3, dtype=torch.uint8),)
    free: tuple[dict[int, Any], ...] = ({} if tracing.one_image else {0: torch.export.Dim("batch")},)
    if tracing.num_slots is not None:
        examples, free = (*examples, torch.arange(tracing.num_slots)), (*free, {0: torch.export.Dim("wanted")})
    with quiet(*_TALKATIVE), _uncollected():
        program = torch.onnx.export(
            network,
            examples,
            input_names=[INPUT, SLOTS][: len(examples)],
            output_names=list(outputs),
            dynamic_shapes=free,
            opset_version=OPSET,
            dynamo=True,
            external_data=False,
            verbose=False,
            optimize=False,
        )
    assert program is not None  # with dynamo there always is one
    return program


def simplified(traced: ir.Model, tracing: Tracing) -> onnx.ModelProto:
    """A traced graph as it is stored; changes the graph that is given.

    Args:
        traced: By :func:`traced_program`.
        tracing: As it was traced. A caller may leave out the wanted slots, which means all of them in their order.
    """
    with quiet(*_TALKATIVE):
        _simplify(traced)
    model: onnx.ModelProto = ir.to_proto(traced)
    _strip(model)
    if tracing.num_slots is not None:
        model.graph.initializer.append(numpy_helper.from_array(np.arange(tracing.num_slots), SLOTS))
    if tracing.one_image:
        model = image_by_image(model)
    onnx.checker.check_model(model)
    return model


def _simplify(model: ir.Model) -> None:
    """Fold what is constant, and drop what is there twice or unused.

    The exporter's own optimiser also tries rewrite rules, some of which compare each node with every other: ten minutes
    for the thousands of nodes of template networks. Runtimes fuse nodes themselves. One rule is needed: where only the
    batch is free, the shape of a Reshape becomes a constant, so that the crop-pose stage does not read its batch from
    the whole image.
    """
    optimizer.inline(model)
    optimizer.fold_constants(model, should_fold=lambda node: node.op_type in _MOVING or None)
    rewriter.rewrite(model, pattern_rewrite_rules=[materialize_reshape_shape_rule])
    for simplify in (
        passes.RemoveUnusedNodesPass(),
        passes.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0),
        passes.DeduplicateInitializersPass(size_limit=_LARGEST_REPEATED),
        passes.CommonSubexpressionEliminationPass(),
        passes.OutputFixPass(),
        passes.NameFixPass(),
    ):
        simplify(model)


@contextmanager
def _uncollected() -> Iterator[None]:
    """Leave garbage for later: tracing makes millions of objects that live on, and to look through them takes long."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


@contextmanager
def quiet(*names: str) -> Iterator[None]:
    """Silence what these loggers say below an error ("" is the root), and deprecation warnings."""
    loggers = [logging.getLogger(name) for name in names]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", category=FutureWarning)
            warnings.filterwarnings("ignore", category=DeprecationWarning)
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _strip(model: onnx.ModelProto) -> None:
    """Drop the exporter's notes, stack traces with this machine's paths among them, and shapes that runtimes infer."""
    graph = model.graph
    del graph.value_info[:]
    parts: list[Any] = [model, graph, *graph.node, *graph.input, *graph.output, *graph.initializer]
    for part in parts:
        del part.metadata_props[:]
        part.ClearField("doc_string")


def store_half(model: onnx.ModelProto) -> None:
    """Store large float32 weights that float16 can hold exactly as such, with a Cast back in the graph."""
    casts, graph = [], inner_graph(model)
    for tensor in graph.initializer:
        if tensor.data_type != TensorProto.FLOAT or np.prod(tensor.dims) < _SMALLEST_HALF:
            continue
        values = numpy_helper.to_array(tensor)
        half = values.astype(np.float16)
        if np.array_equal(half.astype(np.float32), values):
            name = tensor.name
            tensor.CopyFrom(numpy_helper.from_array(half, f"{name}_half"))
            casts.append(helper.make_node("Cast", [tensor.name], [name], name=f"{name}_cast", to=TensorProto.FLOAT))
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
    onnx.checker.check_model(model)


def put_spec(model: onnx.ModelProto, spec: ModelSpec) -> None:
    """Write the specification into the metadata."""
    put_metadata(model, SPEC_KEY, json_format.MessageToJson(spec, preserving_proto_field_name=True, indent=None))


def put_metadata(model: onnx.ModelProto, key: str, text: str) -> None:
    """Write an entry of the metadata, in place of an older one."""
    others = [entry for entry in model.metadata_props if entry.key != key]
    del model.metadata_props[:]
    model.metadata_props.extend(others)
    model.metadata_props.add(key=key, value=text)


def hide_outputs(model: onnx.ModelProto, names: Collection[str]) -> None:
    """Make outputs tensors inside the graph: they keep their names, and runtimes do not compute them for nothing."""
    shown = [value for value in model.graph.output if value.name not in names]
    del model.graph.output[:]
    model.graph.output.extend(shown)
