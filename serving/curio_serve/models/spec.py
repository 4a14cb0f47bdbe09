"""Reads the specification stored in an ONNX file, before any runtime opens the file.

External data is a path out of the model folder waiting to be followed, so a file that has any is refused here. The walk
covers every place where ONNX allows a tensor: initialisers, attributes of nodes, subgraphs, functions, training graphs.
"""

from collections.abc import Collection, Iterable, Iterator, Sequence

from curio_proto.files.onnx_outline_pb2 import (
    OnnxAttribute,
    OnnxGraph,
    OnnxModel,
    OnnxNode,
    OnnxSparseTensor,
    OnnxTensor,
)
from curio_proto.v1.model_spec_pb2 import ModelSpec
from google.protobuf import json_format
from google.protobuf.message import DecodeError

from curio_serve.errors import ArgumentError, ModelError

SPEC_KEY = "curio.model_spec"
SCHEMA_VERSION = 1
_EXTERNAL = 1


def read_spec(data: bytes, path: str) -> ModelSpec:
    """The specification stored in an ONNX file.

    Args:
        data: The file's bytes.
        path: For messages.

    Raises:
        ModelError: Not ONNX, with external data, without a spec, or with one of an unknown version.
    """
    outline = OnnxModel()
    try:
        outline.ParseFromString(data)
    except DecodeError as exc:
        raise ModelError(f"{path} is not an ONNX file ({len(data)} bytes): export it again with curio-export") from exc
    if not outline.HasField("graph"):
        raise ModelError(f"{path} is not an ONNX file: it has no graph; export it again with curio-export")
    for tensor in _tensors(outline):
        if tensor.data_location == _EXTERNAL or tensor.external_data:
            raise ModelError(
                f"{path} keeps the tensor {tensor.name!r} in another file; external data is refused: "
                "export into one file, as curio-export does"
            )
    entries = [entry.value for entry in outline.metadata_props if entry.key == SPEC_KEY]
    if len(entries) != 1:
        raise ModelError(
            f"{path} has {len(entries)} entries {SPEC_KEY} in its metadata, expected 1; export it with curio-export"
        )
    return _parse_spec(entries[0], path)


def read_metadata(data: bytes, key: str) -> str:
    """An entry of the metadata of an ONNX file that :func:`read_spec` has read; empty if there is none."""
    return next((entry.value for entry in OnnxModel.FromString(data).metadata_props if entry.key == key), "")


def check_known(specs: Sequence[ModelSpec], objects: Collection[str]) -> None:
    """Check that some model knows each of these kinds of objects.

    Raises:
        ArgumentError: None knows one of them.
    """
    known = sorted({kind.name for spec in specs for kind in spec.objects})
    if unknown := sorted(set(objects) - set(known)):
        raise ArgumentError(f"objects names {unknown[0][:64]!r}; expected some of {', '.join(known)}")


def wanted_slots(spec: ModelSpec, label: str, objects: Collection[str]) -> list[int]:
    """The slots of these kinds of objects, ascending; of all where no kind is named.

    Raises:
        ArgumentError: The model knows none of them.
    """
    wanted = sorted(slot for kind in spec.objects if not objects or kind.name in objects for slot in kind.slots)
    if not wanted:
        raise ArgumentError(
            f"objects names {', '.join(sorted(objects))}, and model {label} knows none but "
            f"{', '.join(kind.name for kind in spec.objects)}; leave one of them out"
        )
    return wanted


def part_of(spec: ModelSpec, wanted: Sequence[int]) -> ModelSpec:
    """The specification of a model that answers these rows alone."""
    part = ModelSpec()
    part.CopyFrom(spec)
    part.num_slots = len(wanted)
    del part.objects[:]
    for kind in spec.objects:
        if rows := [row for row, slot in enumerate(wanted) if slot in kind.slots]:
            part.objects.add().CopyFrom(kind)
            part.objects[-1].slots[:] = rows
    if spec.HasField("stable_poses"):
        names = {kind.name for kind in part.objects}
        del part.stable_poses.objects[:]
        part.stable_poses.objects.extend(one for one in spec.stable_poses.objects if one.object in names)
    return part


def _parse_spec(text: str, path: str) -> ModelSpec:
    try:
        # Unknown fields pass here, so that a newer schema is refused by its version, not by a field's name.
        spec = json_format.Parse(text, ModelSpec(), ignore_unknown_fields=True, max_recursion_depth=20)
    except json_format.ParseError as exc:
        raise ModelError(f"{path}: the metadata {SPEC_KEY} is not a ModelSpec: {exc}") from exc
    if spec.schema_version != SCHEMA_VERSION:
        raise ModelError(
            f"{path}: ModelSpec has schema version {spec.schema_version}; supported is {SCHEMA_VERSION}. "
            "Use the curio-pose release it was exported with, or export it again"
        )
    return spec


def _tensors(model: OnnxModel) -> Iterator[OnnxTensor]:
    graphs = [model.graph]
    for training in model.training_info:
        graphs += [training.initialization, training.algorithm]
    for graph in graphs:
        yield from _of_graph(graph)
    for function in model.functions:
        yield from _of_attributes(function.attribute_proto)
        yield from _of_nodes(function.node)


def _of_graph(graph: OnnxGraph) -> Iterator[OnnxTensor]:
    yield from graph.initializer
    yield from _of_sparse(graph.sparse_initializer)
    yield from _of_nodes(graph.node)


def _of_nodes(nodes: Iterable[OnnxNode]) -> Iterator[OnnxTensor]:
    for node in nodes:
        yield from _of_attributes(node.attribute)


def _of_attributes(attributes: Iterable[OnnxAttribute]) -> Iterator[OnnxTensor]:
    for attribute in attributes:
        yield attribute.t
        yield from attribute.tensors
        yield from _of_sparse([attribute.sparse_tensor, *attribute.sparse_tensors])
        for graph in (attribute.g, *attribute.graphs):
            if graph.ByteSize():
                yield from _of_graph(graph)


def _of_sparse(tensors: Iterable[OnnxSparseTensor]) -> Iterator[OnnxTensor]:
    for tensor in tensors:
        yield tensor.values
        yield tensor.indices
