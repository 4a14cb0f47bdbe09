"""ONNX files: a torch module written as one, and one run by onnxruntime."""

import logging
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from curio_proto.v1.model_spec_pb2 import ModelSpec
from google.protobuf import json_format
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from curio_train.errors import ExportError

INPUT = "image"
SPEC_KEY = "curio.model_spec"
SCHEMA_VERSION = 1
OPSET = 18
_SMALLEST_HALF = 256  # values; below, a Cast costs more than it saves


def to_onnx(network: nn.Module, width: int, height: int, outputs: Sequence[str]) -> onnx.ModelProto:
    """Trace a network into an ONNX model with a free batch.

    Args:
        network: Takes uint8 RGB [batch, height, width, 3], returns a tuple of tensors.
        width: Of the images, pixels.
        height: Of the images, pixels.
        outputs: Names of the returned tensors, in order.

    Returns:
        A model that holds its weights and nothing of the machine it was traced on.
    """
    example = torch.zeros(2, height, width, 3, dtype=torch.uint8)
    with _quiet():
        program = torch.onnx.export(
            network,
            (example,),
            input_names=[INPUT],
            output_names=list(outputs),
            dynamic_shapes=({0: torch.export.Dim("batch")},),
            opset_version=OPSET,
            dynamo=True,
            external_data=False,
            verbose=False,
        )
    assert program is not None  # with dynamo there always is one
    model: onnx.ModelProto = program.model_proto
    _strip(model)
    onnx.checker.check_model(model)
    return model


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the exporter's remarks about packages that are not needed, and its own deprecations."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", category=FutureWarning)
            warnings.filterwarnings("ignore", category=DeprecationWarning)
            yield
    finally:
        logger.setLevel(level)


def _strip(model: onnx.ModelProto) -> None:
    """Drop the exporter's notes: stack traces with this machine's paths among them."""
    graph = model.graph
    parts: list[Any] = [model, graph, *graph.node, *graph.input, *graph.output, *graph.value_info, *graph.initializer]
    for part in parts:
        del part.metadata_props[:]
        part.ClearField("doc_string")


def store_half(model: onnx.ModelProto) -> None:
    """Store large float32 weights that float16 can hold exactly as such, with a Cast back in the graph."""
    casts = []
    for tensor in model.graph.initializer:
        if tensor.data_type != TensorProto.FLOAT or np.prod(tensor.dims) < _SMALLEST_HALF:
            continue
        values = numpy_helper.to_array(tensor)
        half = values.astype(np.float16)
        if np.array_equal(half.astype(np.float32), values):
            name = tensor.name
            tensor.CopyFrom(numpy_helper.from_array(half, f"{name}_half"))
            casts.append(helper.make_node("Cast", [tensor.name], [name], name=f"{name}_cast", to=TensorProto.FLOAT))
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    onnx.checker.check_model(model)


def put_spec(model: onnx.ModelProto, spec: ModelSpec) -> None:
    """Write the specification into the metadata."""
    del model.metadata_props[:]
    text = json_format.MessageToJson(spec, preserving_proto_field_name=True, indent=None)
    model.metadata_props.add(key=SPEC_KEY, value=text)


class OnnxModel:
    """An exported model, run by onnxruntime as serving runs it.

    Attributes:
        spec: What it says about itself.
    """

    def __init__(self, content: bytes, where: str) -> None:
        """Open a model.

        Args:
            content: Of the file.
            where: The file, for messages.

        Raises:
            ExportError: Not an exported model, or one that onnxruntime refuses.
        """
        # Before the import: unless told not to, onnxruntime from 1.29 on writes an identifier into the user's cache
        # folder and uploads events to its makers (its Privacy.md).
        os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        except _runtime_errors() as exc:
            raise ExportError(f"{where}: onnxruntime refuses the graph ({exc}); export it again") from exc
        self.spec = _read_spec(self._session.get_modelmeta().custom_metadata_map, where)
        self._where = where

    @staticmethod
    def open(path: Path) -> "OnnxModel":
        """The model in a file.

        Raises:
            ExportError: It cannot be read or used.
        """
        try:
            return OnnxModel(path.read_bytes(), str(path))
        except OSError as exc:
            raise ExportError(f"{path} cannot be read: {exc.strerror}; expected an exported .onnx file") from exc

    def __call__(self, images: np.ndarray) -> dict[str, Tensor]:
        """Outputs by name.

        Args:
            images: uint8 RGB [batch, height, width, 3] of the canonical camera's size.

        Raises:
            ExportError: onnxruntime failed on them.
        """
        names = [output.name for output in self._session.get_outputs()]
        try:
            values = self._session.run(names, {INPUT: images})
        except _runtime_errors() as exc:
            raise ExportError(f"{self._where}: onnxruntime failed on {images.shape} images ({exc})") from exc
        return {name: torch.from_numpy(value) for name, value in zip(names, values, strict=True)}


def _runtime_errors() -> tuple[type[Exception], ...]:
    """Onnxruntime's exceptions, which share no base."""
    from onnxruntime.capi import onnxruntime_pybind11_state as runtime

    return (runtime.Fail, runtime.InvalidArgument, runtime.InvalidGraph, runtime.InvalidProtobuf)


def _read_spec(metadata: Mapping[str, str], where: str) -> ModelSpec:
    if SPEC_KEY not in metadata:
        raise ExportError(
            f"{where} has no {SPEC_KEY} in its metadata, only {sorted(metadata)}; expected a model of ours"
        )
    try:
        spec = json_format.Parse(metadata[SPEC_KEY], ModelSpec(), ignore_unknown_fields=True)
    except json_format.ParseError as exc:
        raise ExportError(f"{where}: its {SPEC_KEY} is no ModelSpec ({exc}); export it again") from exc
    if spec.schema_version != SCHEMA_VERSION:
        raise ExportError(
            f"{where}: ModelSpec has schema version {spec.schema_version}, supported is {SCHEMA_VERSION}; "
            "export it again"
        )
    return spec
