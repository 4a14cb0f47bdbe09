"""Loads a model: opens an ONNX file with onnxruntime and checks its specification against its graph."""

import copy
import hashlib
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from curio_proto.v1.model_spec_pb2 import Field, ModelSpec

from curio_serve.errors import CameraError, InternalError, ModelError
from curio_serve.files import read_file
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.view import CanonicalCamera
from curio_serve.models.batching import Batcher
from curio_serve.models.object_frames import center_of
from curio_serve.models.reliability import RELIABILITY_FILE, parse_reliability
from curio_serve.models.runtime import DEFAULT_RUNTIME, Runtime, open_session, runtime_errors
from curio_serve.models.spec import check_known, part_of, read_metadata, read_spec, wanted_slots
from curio_serve.models.stages.crop_stage import CROP_STAGE_KEY, CropStage, CropStageNote
from curio_serve.models.stages.outline_stage import OUTLINE_STAGE_KEY, OutlineStage, OutlineStageNote
from curio_serve.planes.stable_poses import STABLE_POSES_FILE, parse_stable_poses

if TYPE_CHECKING:
    import onnxruntime

INPUT = "image"
SLOTS = "slots"
"""An input that some graphs have beside the image, int64: which slots to answer, all where it is left out."""

MAX_BYTES = 1 << 30
BESIDE = {
    RELIABILITY_FILE: ("reliability", parse_reliability),
    STABLE_POSES_FILE: ("stable_poses", parse_stable_poses),
}
"""Files beside the ONNX file: for each the field of the specification that holds what it says, and its reader."""

_MAX_BESIDE_BYTES = 8 << 20
_MOST_PARTS = 64  # of a model of many objects, which are kept
Outputs = Mapping[str, np.ndarray]

# Shape of each output after [batch, num_slots] or [batch], and whether it is one a slot.
_OUTPUT_SHAPES: dict[str, tuple[tuple[int, ...], bool]] = {
    "translation_m": ((3,), True),
    "rotation_6d": ((6,), True),
    "rotation": ((3, 3), True),
    "color": ((3,), True),
    "confidence": ((), True),
    "presence": ((), True),
    "light": ((3,), False),
}
_ROTATIONS = {"rotation", "rotation_6d"}
# Outputs that the spec need not list: one rotation is derived from the other, and presence is no field of a scene code.
_UNLISTED = {*_ROTATIONS, "presence"}


@dataclass(frozen=True, eq=False)
class Slot:
    """One row of the per-object outputs."""

    object: str
    """Name of the kind of object that the row describes."""
    box_corners: Sequence[Sequence[float]]
    """8 points (x, y, z), object frame, metres (image widths in 2D worlds); empty if the spec has none."""
    center: Sequence[float] = (0.0, 0.0, 0.0)
    """The object's middle (x, y, z), object frame, metres (image widths in 2D worlds)."""


class Model:
    """An exported network, ready to run; safe to share between threads."""

    name: str
    """The name that clients use."""
    version: int
    """Version of the model folder; 0 for a file outside one."""
    spec: ModelSpec
    """Specification as the file stores it, with what the files beside it say."""
    camera: CanonicalCamera
    """The canonical camera, of which its input is an image."""
    slots: Sequence[Slot]
    """One for each row of the per-object outputs."""
    sha256: str
    """SHA-256 of the file, hexadecimal."""
    crop_stage: CropStage | None = None
    """Reads poses from crops alone; None: the model has no such stage."""
    outline_stage: OutlineStage | None = None
    """Aligns what that reads with the object's outline; None: such poses stay as they are read."""

    def __init__(
        self,
        session: "onnxruntime.InferenceSession",
        spec: ModelSpec,
        name: str,
        version: int,
        sha256: str,
        max_batch: int = 1,
    ) -> None:
        self.name, self.version, self.spec, self.sha256 = name, version, spec, sha256
        self.camera = canonical_camera(spec, name)
        self.slots = slots(spec, name)
        self.output_names: Sequence[str] = [output.name for output in session.get_outputs()]
        self._session, self._max_batch = session, max_batch
        self._takes_slots = SLOTS in [given.name for given in session.get_overridable_initializers()]
        self._wanted: np.ndarray | None = None
        self._parts: dict[tuple[int, ...], Model] = {}
        self._run_many = self._runner()

    @property
    def output_shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each output, without the batch."""
        return {name: _shape(name, self.spec.num_slots) for name in self.output_names}

    @property
    def label(self) -> str:
        """Name and version, for messages."""
        return f"{self.name}/{self.version}" if self.version else self.name

    def of(self, objects: Collection[str]) -> "Model":
        """A model that answers these kinds of objects alone, in less time if its graph can leave others out.

        Args:
            objects: Names; of those that it does not know nothing is answered. None: all.

        Raises:
            ArgumentError: It knows none of them.
        """
        wanted = wanted_slots(self.spec, self.label, objects)
        if len(wanted) == len(self.slots):
            return self
        known = self._parts.get(tuple(wanted))
        if known is not None:
            return known
        part = copy.copy(self)
        part.slots, part.spec = [self.slots[row] for row in wanted], part_of(self.spec, wanted)
        part._wanted = np.array(wanted) if self._wanted is None else self._wanted[wanted]
        part._parts, part._run_many = {}, part._runner()
        if len(self._parts) >= _MOST_PARTS:
            return part
        return self._parts.setdefault(tuple(wanted), part)  # one for all calls, which are batched in it

    def _runner(self) -> "Batcher | Callable[[np.ndarray], Sequence[np.ndarray]]":
        return Batcher(self._run, self._max_batch) if self._max_batch > 1 else self._run

    def run(self, images: np.ndarray) -> Outputs:
        """Run the network.

        Args:
            images: uint8 RGB [batch, height, width, 3] of the size of ``camera``.

        Returns:
            Outputs in physical units by name, float32 [batch, ...]: see ``_OUTPUT_SHAPES``.

        Raises:
            InternalError: An output is not finite, or the runtime failed.
        """
        values = self._run_many(images)
        for name, value in zip(self.output_names, values, strict=True):
            # As plain numbers, because there are few: NumPy's two calls take several times as long.
            if not all(map(math.isfinite, value.ravel().tolist())):
                raise InternalError(f"model {self.label}: its output {name} is not finite for this image")
        return dict(zip(self.output_names, values, strict=True))

    def _run(self, images: np.ndarray) -> Sequence[np.ndarray]:
        wanted = self._wanted
        given = {INPUT: images} if wanted is None or not self._takes_slots else {INPUT: images, SLOTS: wanted}
        try:
            outputs: Sequence[np.ndarray] = self._session.run(None, given)
        except runtime_errors() as exc:
            raise InternalError(f"model {self.label}: onnxruntime failed on a batch of {len(images)}: {exc}") from exc
        if wanted is None or self._takes_slots:
            return outputs
        named = zip(self.output_names, outputs, strict=True)
        return [values[:, wanted] if _OUTPUT_SHAPES[name][1] else values for name, values in named]


def answering(models: Sequence[Model], objects: Collection[str]) -> list[Model]:
    """The models, which answer these kinds of objects alone; as they are where no kind is named.

    Raises:
        ArgumentError: No model knows one of the kinds, or a model knows none of them.
    """
    check_known([model.spec for model in models], objects)
    return [model.of(objects) for model in models]


def load(path: Path, name: str = "", version: int = 0, runtime: Runtime = DEFAULT_RUNTIME) -> Model:
    """Read, check and open an ONNX file.

    Args:
        path: The file.
        name: The name that clients use; empty: the name in its spec.
        version: Of the model folder.
        runtime: How the network is run.

    Raises:
        ModelError: Says how the content differs from what its specification or curio requires.
    """
    try:
        data = read_file(path, MAX_BYTES)
    except OSError as exc:
        raise ModelError(f"model file {path} cannot be read: {exc.strerror}; expected an .onnx file") from exc
    model = from_bytes(data, str(path), name, version, runtime)
    for file in BESIDE:
        _add(model, path.with_name(file))
    return model


def _add(model: Model, path: Path) -> None:
    """Add what a file of :data:`BESIDE` says to a model's specification, if it is there."""
    try:
        text = read_file(path, _MAX_BESIDE_BYTES)
    except (FileNotFoundError, NotADirectoryError):
        return
    except OSError as exc:
        raise ModelError(f"{path} cannot be read: {exc.strerror}; expected what curio-export writes") from exc
    field, parse = BESIDE[path.name]
    objects = [kind.name for kind in model.spec.objects]
    getattr(model.spec, field).CopyFrom(parse(text, objects, str(path)))


def from_bytes(data: bytes, where: str, name: str = "", version: int = 0, runtime: Runtime = DEFAULT_RUNTIME) -> Model:
    """Check and open the content of an ONNX file.

    Args:
        data: The content.
        where: The file, for messages.
        name: The name that clients use; empty: the name in its spec.
        version: Of the model folder.
        runtime: How the network is run.

    Raises:
        ModelError: Says how the content differs from what its specification or curio requires.
    """
    spec = read_spec(data, where)
    session = open_session(data, where, runtime.providers)
    name = name or spec.name or Path(where).stem
    model = Model(session, spec, name, version, hashlib.sha256(data).hexdigest(), runtime.max_batch)
    _check_graph(session, model)
    _check_outputs(model)
    if model.camera.matrix is not None and spec.num_slots == 1:
        if note := read_metadata(data, CROP_STAGE_KEY):
            model.crop_stage = CropStage(data, CropStageNote.parse(note, where), where, runtime.providers)
        if note := read_metadata(data, OUTLINE_STAGE_KEY):
            model.outline_stage = OutlineStage(data, OutlineStageNote.parse(note, where), where, runtime.providers)
    return model


def _check_graph(session: "onnxruntime.InferenceSession", model: Model) -> None:
    """Refuse a graph whose inputs and outputs differ in name or type from the spec's."""
    inputs = [(i.name, i.type, i.shape[1:]) for i in session.get_inputs()]
    expected = [(INPUT, "tensor(uint8)", [model.camera.height, model.camera.width, 3])]
    if inputs != expected:
        raise ModelError(f"model {model.label}: its inputs are {inputs}; its spec has {expected}")
    specified = {field.name for field in model.spec.fields}
    found = set(model.output_names)
    if missing := specified - found:
        raise ModelError(f"model {model.label}: its spec has {sorted(missing)}, its graph gives {sorted(found)}")
    if unknown := found - specified - _UNLISTED:
        raise ModelError(f"model {model.label}: its graph gives {sorted(unknown)}, which its spec does not describe")
    if strange := found - _OUTPUT_SHAPES.keys():
        raise ModelError(f"model {model.label}: unknown outputs {sorted(strange)}; known are {sorted(_OUTPUT_SHAPES)}")
    if "translation_m" not in found or len(found & _ROTATIONS) == 1:
        raise ModelError(
            f"model {model.label}: its graph gives {sorted(found)}; expected translation_m, "
            "and rotation and rotation_6d both or neither"
        )
    for field in model.spec.fields:
        _check_field(field, model)


def _shape(name: str, num_slots: int) -> tuple[int, ...]:
    shape, per_object = _OUTPUT_SHAPES[name]
    return (num_slots, *shape) if per_object else shape


def _check_field(field: Field, model: Model) -> None:
    shape, per_object = _OUTPUT_SHAPES[field.name]
    if field.per_object != per_object or field.size != int(np.prod(shape)):
        raise ModelError(
            f"model {model.label}: field {field.name} has size {field.size}, per_object {field.per_object}; "
            f"expected {int(np.prod(shape))}, {per_object}"
        )


def _check_outputs(model: Model) -> None:
    """Run two grey images: refuse wrong shapes, and a graph whose batch is fixed."""
    images = np.full((2, model.camera.height, model.camera.width, 3), 128, np.uint8)
    try:
        outputs = model.run(images)
    except InternalError as exc:
        raise ModelError(f"a grey image cannot pass the graph: {exc}") from exc
    for name, value in outputs.items():
        expected = (2, *_shape(name, model.spec.num_slots))
        if value.shape != expected or value.dtype != np.float32:
            raise ModelError(f"model {model.label}: {name} is {value.dtype} {value.shape}; expected float32 {expected}")


def canonical_camera(spec: ModelSpec, name: str) -> CanonicalCamera:
    """The canonical camera of a spec.

    Raises:
        ModelError: Its size or K* is impossible.
    """
    camera, values = spec.camera, list(spec.camera.camera_matrix)
    if not (camera.width and camera.height) or len(values) not in (0, 9):
        raise ModelError(
            f"model {name}: its spec has a camera of {camera.width}x{camera.height} pixels with {len(values)} values "
            "of K*; expected a size and 9 values (none in 2D worlds)"
        )
    if not values:
        return CanonicalCamera(camera.width, camera.height)
    try:
        matrix = PinholeCamera(np.reshape(values, (3, 3))).matrix
    except CameraError as exc:
        raise ModelError(f"model {name}: its spec's {exc}") from exc
    return CanonicalCamera(camera.width, camera.height, matrix, camera.is_default)


def slots(spec: ModelSpec, name: str) -> tuple[Slot, ...]:
    """The object of each row of the outputs, in the order of the rows.

    Raises:
        ModelError: A row belongs to no object or to two, a box has not 8 corners, or a middle is no point.
    """
    rows: dict[int, Slot] = {}
    for kind in spec.objects:
        values = list(kind.box_corners_m)
        if len(values) not in (0, 24):
            raise ModelError(f"model {name}: the box of {kind.name} has {len(values)} values; expected 8 corners x 3")
        if len(kind.center_m) not in (0, 3) or not all(map(math.isfinite, kind.center_m)):
            raise ModelError(f"model {name}: the middle of {kind.name} is {list(kind.center_m)}; expected 3 values")
        corners = list(zip(values[0::3], values[1::3], values[2::3], strict=True))
        for row in kind.slots:
            if row in rows:
                raise ModelError(f"model {name}: slot {row} belongs to both {rows[row].object} and {kind.name}")
            rows[row] = Slot(kind.name, corners, center_of(kind).tolist())
    if not rows or len(rows) != spec.num_slots or sorted(rows) != list(range(len(rows))):
        raise ModelError(f"model {name}: {spec.num_slots} slots, but its objects name the slots {sorted(rows)}")
    return tuple(rows[row] for row in range(len(rows)))
