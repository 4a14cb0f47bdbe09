from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class TritonType(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    TYPE_INVALID: _ClassVar[TritonType]
    TYPE_UINT8: _ClassVar[TritonType]
    TYPE_FP32: _ClassVar[TritonType]
TYPE_INVALID: TritonType
TYPE_UINT8: TritonType
TYPE_FP32: TritonType

class TritonConfig(_message.Message):
    __slots__ = ("name", "platform", "max_batch_size", "input", "output", "backend", "instance_group", "parameters", "model_warmup")
    NAME_FIELD_NUMBER: _ClassVar[int]
    PLATFORM_FIELD_NUMBER: _ClassVar[int]
    MAX_BATCH_SIZE_FIELD_NUMBER: _ClassVar[int]
    INPUT_FIELD_NUMBER: _ClassVar[int]
    OUTPUT_FIELD_NUMBER: _ClassVar[int]
    BACKEND_FIELD_NUMBER: _ClassVar[int]
    INSTANCE_GROUP_FIELD_NUMBER: _ClassVar[int]
    PARAMETERS_FIELD_NUMBER: _ClassVar[int]
    MODEL_WARMUP_FIELD_NUMBER: _ClassVar[int]
    name: str
    platform: str
    max_batch_size: int
    input: _containers.RepeatedCompositeFieldContainer[TritonTensor]
    output: _containers.RepeatedCompositeFieldContainer[TritonTensor]
    backend: str
    instance_group: _containers.RepeatedCompositeFieldContainer[TritonOther]
    parameters: _containers.RepeatedCompositeFieldContainer[TritonOther]
    model_warmup: _containers.RepeatedCompositeFieldContainer[TritonOther]
    def __init__(self, name: _Optional[str] = ..., platform: _Optional[str] = ..., max_batch_size: _Optional[int] = ..., input: _Optional[_Iterable[_Union[TritonTensor, _Mapping]]] = ..., output: _Optional[_Iterable[_Union[TritonTensor, _Mapping]]] = ..., backend: _Optional[str] = ..., instance_group: _Optional[_Iterable[_Union[TritonOther, _Mapping]]] = ..., parameters: _Optional[_Iterable[_Union[TritonOther, _Mapping]]] = ..., model_warmup: _Optional[_Iterable[_Union[TritonOther, _Mapping]]] = ...) -> None: ...

class TritonOther(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class TritonTensor(_message.Message):
    __slots__ = ("name", "data_type", "dims")
    NAME_FIELD_NUMBER: _ClassVar[int]
    DATA_TYPE_FIELD_NUMBER: _ClassVar[int]
    DIMS_FIELD_NUMBER: _ClassVar[int]
    name: str
    data_type: TritonType
    dims: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, name: _Optional[str] = ..., data_type: _Optional[_Union[TritonType, str]] = ..., dims: _Optional[_Iterable[int]] = ...) -> None: ...
