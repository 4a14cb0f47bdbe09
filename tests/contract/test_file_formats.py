"""The parts of foreign formats that serving reads agree with the formats' own definitions."""

import onnx
import pytest
from curio_proto.files import onnx_outline_pb2 as outline
from google.protobuf.descriptor import Descriptor

_PAIRS = {
    outline.OnnxModel: onnx.ModelProto,
    outline.OnnxProperty: onnx.StringStringEntryProto,
    outline.OnnxGraph: onnx.GraphProto,
    outline.OnnxNode: onnx.NodeProto,
    outline.OnnxAttribute: onnx.AttributeProto,
    outline.OnnxTensor: onnx.TensorProto,
    outline.OnnxSparseTensor: onnx.SparseTensorProto,
    outline.OnnxFunction: onnx.FunctionProto,
    outline.OnnxTraining: onnx.TrainingInfoProto,
}
_PATHS_TO_TENSORS = {pair.DESCRIPTOR.name for pair in _PAIRS.values()} - {"StringStringEntryProto"}


@pytest.mark.parametrize(("ours", "theirs"), _PAIRS.items(), ids=lambda kind: kind.DESCRIPTOR.name)
def test_onnx_field_numbers(ours: type, theirs: type) -> None:
    theirs_by_name = theirs.DESCRIPTOR.fields_by_name
    assert {f.name: f.number for f in ours.DESCRIPTOR.fields} == {
        f.name: theirs_by_name[f.name].number for f in ours.DESCRIPTOR.fields
    }


@pytest.mark.parametrize(("ours", "theirs"), _PAIRS.items(), ids=lambda kind: kind.DESCRIPTOR.name)
def test_no_way_to_a_tensor_is_missing(ours: type, theirs: type) -> None:
    def ways(descriptor: Descriptor) -> set[str]:
        return {f.name for f in descriptor.fields if f.message_type and f.message_type.name in _PATHS_TO_TENSORS}

    assert ways(theirs.DESCRIPTOR) <= {f.name for f in ours.DESCRIPTOR.fields}
