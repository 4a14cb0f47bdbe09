from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ModelSpec(_message.Message):
    __slots__ = ("schema_version", "name", "world", "num_slots", "fields", "objects", "camera", "parity_max_abs_error", "recipe", "commit", "images_seen", "training_seconds", "reliability", "stable_poses")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    WORLD_FIELD_NUMBER: _ClassVar[int]
    NUM_SLOTS_FIELD_NUMBER: _ClassVar[int]
    FIELDS_FIELD_NUMBER: _ClassVar[int]
    OBJECTS_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    PARITY_MAX_ABS_ERROR_FIELD_NUMBER: _ClassVar[int]
    RECIPE_FIELD_NUMBER: _ClassVar[int]
    COMMIT_FIELD_NUMBER: _ClassVar[int]
    IMAGES_SEEN_FIELD_NUMBER: _ClassVar[int]
    TRAINING_SECONDS_FIELD_NUMBER: _ClassVar[int]
    RELIABILITY_FIELD_NUMBER: _ClassVar[int]
    STABLE_POSES_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    name: str
    world: str
    num_slots: int
    fields: _containers.RepeatedCompositeFieldContainer[Field]
    objects: _containers.RepeatedCompositeFieldContainer[ObjectModel]
    camera: CanonicalCamera
    parity_max_abs_error: float
    recipe: str
    commit: str
    images_seen: int
    training_seconds: float
    reliability: Reliability
    stable_poses: StablePoses
    def __init__(self, schema_version: _Optional[int] = ..., name: _Optional[str] = ..., world: _Optional[str] = ..., num_slots: _Optional[int] = ..., fields: _Optional[_Iterable[_Union[Field, _Mapping]]] = ..., objects: _Optional[_Iterable[_Union[ObjectModel, _Mapping]]] = ..., camera: _Optional[_Union[CanonicalCamera, _Mapping]] = ..., parity_max_abs_error: _Optional[float] = ..., recipe: _Optional[str] = ..., commit: _Optional[str] = ..., images_seen: _Optional[int] = ..., training_seconds: _Optional[float] = ..., reliability: _Optional[_Union[Reliability, _Mapping]] = ..., stable_poses: _Optional[_Union[StablePoses, _Mapping]] = ...) -> None: ...

class StablePoses(_message.Message):
    __slots__ = ("objects",)
    OBJECTS_FIELD_NUMBER: _ClassVar[int]
    objects: _containers.RepeatedCompositeFieldContainer[ObjectStablePoses]
    def __init__(self, objects: _Optional[_Iterable[_Union[ObjectStablePoses, _Mapping]]] = ...) -> None: ...

class ObjectStablePoses(_message.Message):
    __slots__ = ("object", "hull_m", "up")
    OBJECT_FIELD_NUMBER: _ClassVar[int]
    HULL_M_FIELD_NUMBER: _ClassVar[int]
    UP_FIELD_NUMBER: _ClassVar[int]
    object: str
    hull_m: _containers.RepeatedScalarFieldContainer[float]
    up: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, object: _Optional[str] = ..., hull_m: _Optional[_Iterable[float]] = ..., up: _Optional[_Iterable[float]] = ...) -> None: ...

class Reliability(_message.Message):
    __slots__ = ("level", "num_images", "objects", "num_photographs", "calibration", "position_widening", "rotation_widening")
    LEVEL_FIELD_NUMBER: _ClassVar[int]
    NUM_IMAGES_FIELD_NUMBER: _ClassVar[int]
    OBJECTS_FIELD_NUMBER: _ClassVar[int]
    NUM_PHOTOGRAPHS_FIELD_NUMBER: _ClassVar[int]
    CALIBRATION_FIELD_NUMBER: _ClassVar[int]
    POSITION_WIDENING_FIELD_NUMBER: _ClassVar[int]
    ROTATION_WIDENING_FIELD_NUMBER: _ClassVar[int]
    level: float
    num_images: int
    objects: _containers.RepeatedCompositeFieldContainer[ObjectReliability]
    num_photographs: int
    calibration: _containers.RepeatedScalarFieldContainer[float]
    position_widening: float
    rotation_widening: float
    def __init__(self, level: _Optional[float] = ..., num_images: _Optional[int] = ..., objects: _Optional[_Iterable[_Union[ObjectReliability, _Mapping]]] = ..., num_photographs: _Optional[int] = ..., calibration: _Optional[_Iterable[float]] = ..., position_widening: _Optional[float] = ..., rotation_widening: _Optional[float] = ...) -> None: ...

class ObjectReliability(_message.Message):
    __slots__ = ("object", "min_confidence", "bounds")
    OBJECT_FIELD_NUMBER: _ClassVar[int]
    MIN_CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    BOUNDS_FIELD_NUMBER: _ClassVar[int]
    object: str
    min_confidence: float
    bounds: _containers.RepeatedCompositeFieldContainer[PoseBounds]
    def __init__(self, object: _Optional[str] = ..., min_confidence: _Optional[float] = ..., bounds: _Optional[_Iterable[_Union[PoseBounds, _Mapping]]] = ...) -> None: ...

class PoseBounds(_message.Message):
    __slots__ = ("min_confidence", "lateral_m", "depth_fraction", "rotation_deg")
    MIN_CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    LATERAL_M_FIELD_NUMBER: _ClassVar[int]
    DEPTH_FRACTION_FIELD_NUMBER: _ClassVar[int]
    ROTATION_DEG_FIELD_NUMBER: _ClassVar[int]
    min_confidence: float
    lateral_m: float
    depth_fraction: float
    rotation_deg: float
    def __init__(self, min_confidence: _Optional[float] = ..., lateral_m: _Optional[float] = ..., depth_fraction: _Optional[float] = ..., rotation_deg: _Optional[float] = ...) -> None: ...

class Field(_message.Message):
    __slots__ = ("name", "size", "per_object", "unit", "frame", "lower", "upper", "activation")
    NAME_FIELD_NUMBER: _ClassVar[int]
    SIZE_FIELD_NUMBER: _ClassVar[int]
    PER_OBJECT_FIELD_NUMBER: _ClassVar[int]
    UNIT_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    LOWER_FIELD_NUMBER: _ClassVar[int]
    UPPER_FIELD_NUMBER: _ClassVar[int]
    ACTIVATION_FIELD_NUMBER: _ClassVar[int]
    name: str
    size: int
    per_object: bool
    unit: str
    frame: str
    lower: _containers.RepeatedScalarFieldContainer[float]
    upper: _containers.RepeatedScalarFieldContainer[float]
    activation: str
    def __init__(self, name: _Optional[str] = ..., size: _Optional[int] = ..., per_object: bool = ..., unit: _Optional[str] = ..., frame: _Optional[str] = ..., lower: _Optional[_Iterable[float]] = ..., upper: _Optional[_Iterable[float]] = ..., activation: _Optional[str] = ...) -> None: ...

class ObjectModel(_message.Message):
    __slots__ = ("name", "mesh_sha256", "diameter_m", "box_corners_m", "symmetries", "slots", "center_m")
    NAME_FIELD_NUMBER: _ClassVar[int]
    MESH_SHA256_FIELD_NUMBER: _ClassVar[int]
    DIAMETER_M_FIELD_NUMBER: _ClassVar[int]
    BOX_CORNERS_M_FIELD_NUMBER: _ClassVar[int]
    SYMMETRIES_FIELD_NUMBER: _ClassVar[int]
    SLOTS_FIELD_NUMBER: _ClassVar[int]
    CENTER_M_FIELD_NUMBER: _ClassVar[int]
    name: str
    mesh_sha256: str
    diameter_m: float
    box_corners_m: _containers.RepeatedScalarFieldContainer[float]
    symmetries: _containers.RepeatedCompositeFieldContainer[Symmetry]
    slots: _containers.RepeatedScalarFieldContainer[int]
    center_m: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, name: _Optional[str] = ..., mesh_sha256: _Optional[str] = ..., diameter_m: _Optional[float] = ..., box_corners_m: _Optional[_Iterable[float]] = ..., symmetries: _Optional[_Iterable[_Union[Symmetry, _Mapping]]] = ..., slots: _Optional[_Iterable[int]] = ..., center_m: _Optional[_Iterable[float]] = ...) -> None: ...

class Symmetry(_message.Message):
    __slots__ = ("transform", "axis", "offset_m")
    TRANSFORM_FIELD_NUMBER: _ClassVar[int]
    AXIS_FIELD_NUMBER: _ClassVar[int]
    OFFSET_M_FIELD_NUMBER: _ClassVar[int]
    transform: _containers.RepeatedScalarFieldContainer[float]
    axis: _containers.RepeatedScalarFieldContainer[float]
    offset_m: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, transform: _Optional[_Iterable[float]] = ..., axis: _Optional[_Iterable[float]] = ..., offset_m: _Optional[_Iterable[float]] = ...) -> None: ...

class CanonicalCamera(_message.Message):
    __slots__ = ("width", "height", "camera_matrix", "is_default")
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    CAMERA_MATRIX_FIELD_NUMBER: _ClassVar[int]
    IS_DEFAULT_FIELD_NUMBER: _ClassVar[int]
    width: int
    height: int
    camera_matrix: _containers.RepeatedScalarFieldContainer[float]
    is_default: bool
    def __init__(self, width: _Optional[int] = ..., height: _Optional[int] = ..., camera_matrix: _Optional[_Iterable[float]] = ..., is_default: bool = ...) -> None: ...
