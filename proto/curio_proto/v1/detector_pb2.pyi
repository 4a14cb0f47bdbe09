from curio_proto.v1 import model_spec_pb2 as _model_spec_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class PixelFormat(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    PIXEL_FORMAT_UNSPECIFIED: _ClassVar[PixelFormat]
    PIXEL_FORMAT_RGB8: _ClassVar[PixelFormat]
    PIXEL_FORMAT_BGR8: _ClassVar[PixelFormat]
    PIXEL_FORMAT_GRAY8: _ClassVar[PixelFormat]

class RegionStatus(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    REGION_STATUS_UNSPECIFIED: _ClassVar[RegionStatus]
    REGION_STATUS_DETECTED: _ClassVar[RegionStatus]
    REGION_STATUS_NO_OBJECT: _ClassVar[RegionStatus]
    REGION_STATUS_OUTSIDE_FRAME: _ClassVar[RegionStatus]
    REGION_STATUS_UNSURE: _ClassVar[RegionStatus]

class DetectionStatus(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DETECTION_STATUS_UNSPECIFIED: _ClassVar[DetectionStatus]
    DETECTION_STATUS_SURE: _ClassVar[DetectionStatus]
    DETECTION_STATUS_UNSURE: _ClassVar[DetectionStatus]
PIXEL_FORMAT_UNSPECIFIED: PixelFormat
PIXEL_FORMAT_RGB8: PixelFormat
PIXEL_FORMAT_BGR8: PixelFormat
PIXEL_FORMAT_GRAY8: PixelFormat
REGION_STATUS_UNSPECIFIED: RegionStatus
REGION_STATUS_DETECTED: RegionStatus
REGION_STATUS_NO_OBJECT: RegionStatus
REGION_STATUS_OUTSIDE_FRAME: RegionStatus
REGION_STATUS_UNSURE: RegionStatus
DETECTION_STATUS_UNSPECIFIED: DetectionStatus
DETECTION_STATUS_SURE: DetectionStatus
DETECTION_STATUS_UNSURE: DetectionStatus

class ModelSelector(_message.Message):
    __slots__ = ("name", "version")
    NAME_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    name: str
    version: int
    def __init__(self, name: _Optional[str] = ..., version: _Optional[int] = ...) -> None: ...

class RawImage(_message.Message):
    __slots__ = ("format", "width", "height", "stride", "data")
    FORMAT_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    STRIDE_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    format: PixelFormat
    width: int
    height: int
    stride: int
    data: bytes
    def __init__(self, format: _Optional[_Union[PixelFormat, str]] = ..., width: _Optional[int] = ..., height: _Optional[int] = ..., stride: _Optional[int] = ..., data: _Optional[bytes] = ...) -> None: ...

class Camera(_message.Message):
    __slots__ = ("camera_matrix", "distortion", "width", "height")
    CAMERA_MATRIX_FIELD_NUMBER: _ClassVar[int]
    DISTORTION_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    camera_matrix: _containers.RepeatedScalarFieldContainer[float]
    distortion: _containers.RepeatedScalarFieldContainer[float]
    width: int
    height: int
    def __init__(self, camera_matrix: _Optional[_Iterable[float]] = ..., distortion: _Optional[_Iterable[float]] = ..., width: _Optional[int] = ..., height: _Optional[int] = ...) -> None: ...

class Region(_message.Message):
    __slots__ = ("x", "y", "width", "height")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    width: float
    height: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., width: _Optional[float] = ..., height: _Optional[float] = ...) -> None: ...

class DetectRequest(_message.Message):
    __slots__ = ("request_id", "models", "encoded", "raw", "camera", "regions", "min_confidence", "max_detections", "apply_exif_rotation", "track", "max_instances", "views", "reads", "objects", "plane")
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    MODELS_FIELD_NUMBER: _ClassVar[int]
    ENCODED_FIELD_NUMBER: _ClassVar[int]
    RAW_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    REGIONS_FIELD_NUMBER: _ClassVar[int]
    MIN_CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    MAX_DETECTIONS_FIELD_NUMBER: _ClassVar[int]
    APPLY_EXIF_ROTATION_FIELD_NUMBER: _ClassVar[int]
    TRACK_FIELD_NUMBER: _ClassVar[int]
    MAX_INSTANCES_FIELD_NUMBER: _ClassVar[int]
    VIEWS_FIELD_NUMBER: _ClassVar[int]
    READS_FIELD_NUMBER: _ClassVar[int]
    OBJECTS_FIELD_NUMBER: _ClassVar[int]
    PLANE_FIELD_NUMBER: _ClassVar[int]
    request_id: str
    models: _containers.RepeatedCompositeFieldContainer[ModelSelector]
    encoded: bytes
    raw: RawImage
    camera: Camera
    regions: _containers.RepeatedCompositeFieldContainer[Region]
    min_confidence: float
    max_detections: int
    apply_exif_rotation: bool
    track: Tracking
    max_instances: int
    views: _containers.RepeatedCompositeFieldContainer[View]
    reads: int
    objects: _containers.RepeatedScalarFieldContainer[str]
    plane: Plane
    def __init__(self, request_id: _Optional[str] = ..., models: _Optional[_Iterable[_Union[ModelSelector, _Mapping]]] = ..., encoded: _Optional[bytes] = ..., raw: _Optional[_Union[RawImage, _Mapping]] = ..., camera: _Optional[_Union[Camera, _Mapping]] = ..., regions: _Optional[_Iterable[_Union[Region, _Mapping]]] = ..., min_confidence: _Optional[float] = ..., max_detections: _Optional[int] = ..., apply_exif_rotation: bool = ..., track: _Optional[_Union[Tracking, _Mapping]] = ..., max_instances: _Optional[int] = ..., views: _Optional[_Iterable[_Union[View, _Mapping]]] = ..., reads: _Optional[int] = ..., objects: _Optional[_Iterable[str]] = ..., plane: _Optional[_Union[Plane, _Mapping]] = ...) -> None: ...

class Plane(_message.Message):
    __slots__ = ("point_m", "normal")
    POINT_M_FIELD_NUMBER: _ClassVar[int]
    NORMAL_FIELD_NUMBER: _ClassVar[int]
    point_m: _containers.RepeatedScalarFieldContainer[float]
    normal: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, point_m: _Optional[_Iterable[float]] = ..., normal: _Optional[_Iterable[float]] = ...) -> None: ...

class View(_message.Message):
    __slots__ = ("encoded", "raw", "camera", "cam_from_rig")
    ENCODED_FIELD_NUMBER: _ClassVar[int]
    RAW_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    CAM_FROM_RIG_FIELD_NUMBER: _ClassVar[int]
    encoded: bytes
    raw: RawImage
    camera: Camera
    cam_from_rig: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, encoded: _Optional[bytes] = ..., raw: _Optional[_Union[RawImage, _Mapping]] = ..., camera: _Optional[_Union[Camera, _Mapping]] = ..., cam_from_rig: _Optional[_Iterable[float]] = ...) -> None: ...

class Tracking(_message.Message):
    __slots__ = ("time_s", "keep_s", "num_objects", "search", "restart")
    TIME_S_FIELD_NUMBER: _ClassVar[int]
    KEEP_S_FIELD_NUMBER: _ClassVar[int]
    NUM_OBJECTS_FIELD_NUMBER: _ClassVar[int]
    SEARCH_FIELD_NUMBER: _ClassVar[int]
    RESTART_FIELD_NUMBER: _ClassVar[int]
    time_s: float
    keep_s: float
    num_objects: int
    search: bool
    restart: bool
    def __init__(self, time_s: _Optional[float] = ..., keep_s: _Optional[float] = ..., num_objects: _Optional[int] = ..., search: bool = ..., restart: bool = ...) -> None: ...

class PoseInterval(_message.Message):
    __slots__ = ("level", "lateral_m", "depth_m", "rotation_deg")
    LEVEL_FIELD_NUMBER: _ClassVar[int]
    LATERAL_M_FIELD_NUMBER: _ClassVar[int]
    DEPTH_M_FIELD_NUMBER: _ClassVar[int]
    ROTATION_DEG_FIELD_NUMBER: _ClassVar[int]
    level: float
    lateral_m: float
    depth_m: float
    rotation_deg: float
    def __init__(self, level: _Optional[float] = ..., lateral_m: _Optional[float] = ..., depth_m: _Optional[float] = ..., rotation_deg: _Optional[float] = ...) -> None: ...

class Detection(_message.Message):
    __slots__ = ("object", "confidence", "translation_m", "rotation_6d", "rotation", "quaternion_xyzw", "color", "box_px", "outside_trained_range", "track", "views", "status", "interval", "presence", "on_plane")
    OBJECT_FIELD_NUMBER: _ClassVar[int]
    CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    TRANSLATION_M_FIELD_NUMBER: _ClassVar[int]
    ROTATION_6D_FIELD_NUMBER: _ClassVar[int]
    ROTATION_FIELD_NUMBER: _ClassVar[int]
    QUATERNION_XYZW_FIELD_NUMBER: _ClassVar[int]
    COLOR_FIELD_NUMBER: _ClassVar[int]
    BOX_PX_FIELD_NUMBER: _ClassVar[int]
    OUTSIDE_TRAINED_RANGE_FIELD_NUMBER: _ClassVar[int]
    TRACK_FIELD_NUMBER: _ClassVar[int]
    VIEWS_FIELD_NUMBER: _ClassVar[int]
    STATUS_FIELD_NUMBER: _ClassVar[int]
    INTERVAL_FIELD_NUMBER: _ClassVar[int]
    PRESENCE_FIELD_NUMBER: _ClassVar[int]
    ON_PLANE_FIELD_NUMBER: _ClassVar[int]
    object: str
    confidence: float
    translation_m: _containers.RepeatedScalarFieldContainer[float]
    rotation_6d: _containers.RepeatedScalarFieldContainer[float]
    rotation: _containers.RepeatedScalarFieldContainer[float]
    quaternion_xyzw: _containers.RepeatedScalarFieldContainer[float]
    color: _containers.RepeatedScalarFieldContainer[float]
    box_px: _containers.RepeatedScalarFieldContainer[float]
    outside_trained_range: bool
    track: Track
    views: _containers.RepeatedScalarFieldContainer[int]
    status: DetectionStatus
    interval: PoseInterval
    presence: float
    on_plane: bool
    def __init__(self, object: _Optional[str] = ..., confidence: _Optional[float] = ..., translation_m: _Optional[_Iterable[float]] = ..., rotation_6d: _Optional[_Iterable[float]] = ..., rotation: _Optional[_Iterable[float]] = ..., quaternion_xyzw: _Optional[_Iterable[float]] = ..., color: _Optional[_Iterable[float]] = ..., box_px: _Optional[_Iterable[float]] = ..., outside_trained_range: bool = ..., track: _Optional[_Union[Track, _Mapping]] = ..., views: _Optional[_Iterable[int]] = ..., status: _Optional[_Union[DetectionStatus, str]] = ..., interval: _Optional[_Union[PoseInterval, _Mapping]] = ..., presence: _Optional[float] = ..., on_plane: bool = ...) -> None: ...

class Track(_message.Message):
    __slots__ = ("track_id", "age_s", "unseen_s", "predicted", "translation_m", "rotation", "quaternion_xyzw", "velocity_m_s", "position_std_m", "rotation_std_rad")
    TRACK_ID_FIELD_NUMBER: _ClassVar[int]
    AGE_S_FIELD_NUMBER: _ClassVar[int]
    UNSEEN_S_FIELD_NUMBER: _ClassVar[int]
    PREDICTED_FIELD_NUMBER: _ClassVar[int]
    TRANSLATION_M_FIELD_NUMBER: _ClassVar[int]
    ROTATION_FIELD_NUMBER: _ClassVar[int]
    QUATERNION_XYZW_FIELD_NUMBER: _ClassVar[int]
    VELOCITY_M_S_FIELD_NUMBER: _ClassVar[int]
    POSITION_STD_M_FIELD_NUMBER: _ClassVar[int]
    ROTATION_STD_RAD_FIELD_NUMBER: _ClassVar[int]
    track_id: int
    age_s: float
    unseen_s: float
    predicted: bool
    translation_m: _containers.RepeatedScalarFieldContainer[float]
    rotation: _containers.RepeatedScalarFieldContainer[float]
    quaternion_xyzw: _containers.RepeatedScalarFieldContainer[float]
    velocity_m_s: _containers.RepeatedScalarFieldContainer[float]
    position_std_m: _containers.RepeatedScalarFieldContainer[float]
    rotation_std_rad: float
    def __init__(self, track_id: _Optional[int] = ..., age_s: _Optional[float] = ..., unseen_s: _Optional[float] = ..., predicted: bool = ..., translation_m: _Optional[_Iterable[float]] = ..., rotation: _Optional[_Iterable[float]] = ..., quaternion_xyzw: _Optional[_Iterable[float]] = ..., velocity_m_s: _Optional[_Iterable[float]] = ..., position_std_m: _Optional[_Iterable[float]] = ..., rotation_std_rad: _Optional[float] = ...) -> None: ...

class RegionResult(_message.Message):
    __slots__ = ("model", "model_version", "region", "status", "detections", "light", "plane")
    MODEL_FIELD_NUMBER: _ClassVar[int]
    MODEL_VERSION_FIELD_NUMBER: _ClassVar[int]
    REGION_FIELD_NUMBER: _ClassVar[int]
    STATUS_FIELD_NUMBER: _ClassVar[int]
    DETECTIONS_FIELD_NUMBER: _ClassVar[int]
    LIGHT_FIELD_NUMBER: _ClassVar[int]
    PLANE_FIELD_NUMBER: _ClassVar[int]
    model: str
    model_version: int
    region: int
    status: RegionStatus
    detections: _containers.RepeatedCompositeFieldContainer[Detection]
    light: _containers.RepeatedScalarFieldContainer[float]
    plane: Plane
    def __init__(self, model: _Optional[str] = ..., model_version: _Optional[int] = ..., region: _Optional[int] = ..., status: _Optional[_Union[RegionStatus, str]] = ..., detections: _Optional[_Iterable[_Union[Detection, _Mapping]]] = ..., light: _Optional[_Iterable[float]] = ..., plane: _Optional[_Union[Plane, _Mapping]] = ...) -> None: ...

class Milliseconds(_message.Message):
    __slots__ = ("queue", "decode", "inference")
    QUEUE_FIELD_NUMBER: _ClassVar[int]
    DECODE_FIELD_NUMBER: _ClassVar[int]
    INFERENCE_FIELD_NUMBER: _ClassVar[int]
    queue: float
    decode: float
    inference: float
    def __init__(self, queue: _Optional[float] = ..., decode: _Optional[float] = ..., inference: _Optional[float] = ...) -> None: ...

class FrameError(_message.Message):
    __slots__ = ("code", "reason", "message")
    CODE_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    code: int
    reason: str
    message: str
    def __init__(self, code: _Optional[int] = ..., reason: _Optional[str] = ..., message: _Optional[str] = ...) -> None: ...

class DetectResponse(_message.Message):
    __slots__ = ("request_id", "width", "height", "results", "milliseconds", "error")
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    RESULTS_FIELD_NUMBER: _ClassVar[int]
    MILLISECONDS_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    request_id: str
    width: int
    height: int
    results: _containers.RepeatedCompositeFieldContainer[RegionResult]
    milliseconds: Milliseconds
    error: FrameError
    def __init__(self, request_id: _Optional[str] = ..., width: _Optional[int] = ..., height: _Optional[int] = ..., results: _Optional[_Iterable[_Union[RegionResult, _Mapping]]] = ..., milliseconds: _Optional[_Union[Milliseconds, _Mapping]] = ..., error: _Optional[_Union[FrameError, _Mapping]] = ...) -> None: ...

class ListModelsRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class ModelInfo(_message.Message):
    __slots__ = ("name", "versions", "world", "objects")
    NAME_FIELD_NUMBER: _ClassVar[int]
    VERSIONS_FIELD_NUMBER: _ClassVar[int]
    WORLD_FIELD_NUMBER: _ClassVar[int]
    OBJECTS_FIELD_NUMBER: _ClassVar[int]
    name: str
    versions: _containers.RepeatedScalarFieldContainer[int]
    world: str
    objects: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, name: _Optional[str] = ..., versions: _Optional[_Iterable[int]] = ..., world: _Optional[str] = ..., objects: _Optional[_Iterable[str]] = ...) -> None: ...

class ListModelsResponse(_message.Message):
    __slots__ = ("models",)
    MODELS_FIELD_NUMBER: _ClassVar[int]
    models: _containers.RepeatedCompositeFieldContainer[ModelInfo]
    def __init__(self, models: _Optional[_Iterable[_Union[ModelInfo, _Mapping]]] = ...) -> None: ...

class GetModelRequest(_message.Message):
    __slots__ = ("model",)
    MODEL_FIELD_NUMBER: _ClassVar[int]
    model: ModelSelector
    def __init__(self, model: _Optional[_Union[ModelSelector, _Mapping]] = ...) -> None: ...

class GetModelResponse(_message.Message):
    __slots__ = ("spec", "version")
    SPEC_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    spec: _model_spec_pb2.ModelSpec
    version: int
    def __init__(self, spec: _Optional[_Union[_model_spec_pb2.ModelSpec, _Mapping]] = ..., version: _Optional[int] = ...) -> None: ...
