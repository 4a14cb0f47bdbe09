"""What a detection looks like as JSON Lines, CSV and BOP results, and how such lines are read back after a stop.

Each format knows four things: the line the file opens with, the lines of one image, how those lines name the image, and
what one line says. Where several models are run, an image has the lines of each, in the order of the models. The file
itself is :mod:`curio_serve.batch.results.result_file`'s.
"""

import csv
import io
import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import PurePath

from curio_proto.v1.detector_pb2 import Detection, RegionResult

from curio_serve.batch.images.source_image import RecordedAt
from curio_serve.batch.results.detection_json import STATUS, detection_json, finite, rows
from curio_serve.errors import UsageError

_LIKELY = 0.5  # confidence of poses that cameras of a rig should agree on


@dataclass(frozen=True)
class ImageResult:
    """The detections of one image, or its error."""

    image: str
    """Its path as given."""
    model: str
    """Name of the model."""
    version: int
    """Version of the model."""
    width: int | None = None
    """Width of the decoded frame in pixels; None where it could not be decoded. Likewise ``height``."""
    height: int | None = None
    camera_matrix: Sequence[float] = ()
    """The K that was used, 9 values row-major; empty if none was."""
    results: Sequence[RegionResult] = field(default_factory=tuple)
    """The model's detections; empty if there is an error."""
    decode_ms: float | None = None
    """Milliseconds from bytes to pixels."""
    inference_ms: float | None = None
    """Milliseconds from pixels to detections."""
    error: str = ""
    """Why there is no answer."""
    is_turned: bool = False
    """EXIF asks for a rotation that was not applied."""
    recorded: RecordedAt | None = None
    """Topic and times of an image of a robot's recording, else None."""
    views: Sequence[str] = ()
    """Images of all cameras of a rig; poses are then in the rig's frame."""
    cam_from_rig: Sequence[float] = ()
    """Pose of a rig's first camera, which took ``image``: 16 values row-major, metres; empty without a rig."""
    distortion: Sequence[float] = ()
    """OpenCV's coefficients that were used with K; empty if none were."""
    exif_rotation: bool = False
    """The pixels were rotated as EXIF asks; size, K and distortion are of the frame after that."""
    searched: float = 1.0
    """Fraction of the frame that the model was shown: of a frame that shows more than the model's camera, the middle.
    """

    @property
    def detections(self) -> list[Detection]:
        return [detection for result in self.results for detection in result.detections]

    @property
    def light(self) -> list[float]:
        """[3] towards the light, camera frame; empty where the world has none."""
        return next((list(result.light) for result in self.results if result.light), [])

    @property
    def plane(self) -> dict[str, list[float]]:
        """The plane on which objects stand, camera frame; empty where none was given or found."""
        found = next((result.plane for result in self.results if result.HasField("plane")), None)
        return {} if found is None else {"point_m": list(found.point_m), "normal": list(found.normal)}


@dataclass(frozen=True)
class ImageLines:
    """The lines of a result file that belong to one image."""

    image: str
    """Its path as given."""
    error: str
    """Why there is no answer."""
    data: bytes
    """The lines, each with its newline."""
    is_turned: bool = False
    """EXIF asks for a rotation that was not applied."""
    searched: float = 1.0
    """Fraction of the frame that models were shown, the smallest one."""
    do_views_agree: bool | None = None
    """Whether two cameras of a rig agree on a pose; None where none says a likely one."""


@dataclass(frozen=True)
class Line:
    """One line of an existing result file."""

    key: str
    """Names the image, see :meth:`ResultFormat.key`."""
    opens_image: bool
    """Whether it is the first line of its image."""
    model: tuple[str, int] | None = None
    """(name, version), if the format has them."""
    is_error: bool = False
    """Whether the image had no answer."""
    camera: tuple[float, ...] = ()
    """K row after row and then the distortion, where the format has it and the stored pixels were not turned."""
    options: Mapping[str, object] | None = None
    """With which the image was answered, where the format has them."""


class ResultFormat(ABC):
    """A text format for results."""

    opening: bytes
    """The text that every file of this format begins with."""
    header: bytes = b""
    """The opening, if it is a whole line; else empty."""
    has_line_for_every_image: bool = True
    """Whether images without detections have a line, too."""
    is_one_line_an_image: bool = False
    """Whether each image has exactly one line of each model."""
    options: Mapping[str, object] | None = None
    """Options of the call that its lines hold; None where the format has no place for them."""

    def lines(self, results: Sequence[ImageResult]) -> ImageLines:
        """Format the lines of an image, those of one model after those of another."""
        errors = dict.fromkeys(result.error for result in results if result.error)
        is_turned, searched = any(result.is_turned for result in results), min(result.searched for result in results)
        data = b"".join(map(self.encode, results))
        return ImageLines(results[0].image, "; ".join(errors), data, is_turned, searched, _do_views_agree(results))

    @abstractmethod
    def encode(self, result: ImageResult) -> bytes:
        """The lines of one model about one image, each with its newline."""

    @abstractmethod
    def key(self, image: str) -> str:
        """The name of an image in lines of this format."""

    @abstractmethod
    def parse(self, line: bytes) -> Line:
        """Parse a line of an existing file.

        Raises:
            ValueError: The line is not of this format.
        """


def _do_views_agree(results: Sequence[ImageResult]) -> bool | None:
    of_rigs = (detection for result in results if result.views for detection in result.detections)
    likely = [detection for detection in of_rigs if detection.confidence >= _LIKELY]
    return any(len(detection.views) > 1 for detection in likely) if likely else None


class JsonLines(ResultFormat):
    """One JSON object an image, always with the same keys; ``error`` stands in place of ``detections``.

    What does not apply (the rotation of a flat object, the size of what is no image) is null. ``views``,
    ``cam_from_rig``, ``distortion``, ``exif_rotation``, ``plane`` and ``options`` are there only where they apply.

    Args:
        options: Of the call: those that change answers and are not the default.
    """

    opening = b'{"image": '
    is_one_line_an_image = True

    def __init__(self, options: Mapping[str, object] | None = None) -> None:
        self.options = dict(options or {})

    def encode(self, result: ImageResult) -> bytes:
        answer: dict[str, object] = {"detections": [detection_json(detection) for detection in result.detections]}
        record = {
            "image": result.image,
            **({"views": list(result.views)} if result.views else {}),
            "width": result.width,
            "height": result.height,
            "camera_matrix": rows(result.camera_matrix, 3) or None,
            **({"cam_from_rig": rows(result.cam_from_rig, 4)} if result.cam_from_rig else {}),
            **({"distortion": list(result.distortion)} if any(result.distortion) else {}),
            **({"exif_rotation": True} if result.exif_rotation else {}),
            **({"error": result.error} if result.error else answer),
            "light": result.light or None,
            **({"plane": result.plane} if result.plane else {}),
            "model": {"name": result.model, "version": result.version},
            **({"options": self.options} if self.options else {}),
            "milliseconds": {"decode": _rounded(result.decode_ms), "inference": _rounded(result.inference_ms)},
        }
        return json.dumps(record, allow_nan=False).encode() + b"\n"

    def key(self, image: str) -> str:
        return image

    def parse(self, line: bytes) -> Line:
        record = json.loads(line)
        try:
            model = (record["model"]["name"], record["model"]["version"])
            key = "|".join(record["views"]) if "views" in record else record["image"]
            is_stored = record.get("camera_matrix") and not record.get("exif_rotation") and "error" not in record
            values = (*chain(*record["camera_matrix"]), *record.get("distortion", ())) if is_stored else ()
            camera = tuple(float(value) for value in values)
            options = dict(record.get("options", {}))
            return Line(key, opens_image=True, model=model, is_error="error" in record, camera=camera, options=options)
        except (KeyError, TypeError) as exc:
            raise ValueError("no image or model in it") from exc


class Csv(ResultFormat):
    """One row a detection, and one with empty fields for an image without any."""

    columns = (
        *("image", "width", "height", "model", "version", "detection", "object", "confidence"),
        *("x_m", "y_m", "z_m", "r11", "r12", "r13", "r21", "r22", "r23", "r31", "r32", "r33"),
        *("qx", "qy", "qz", "qw", "red", "green", "blue"),
        *(f"box_{axis}{corner}_px" for corner in range(8) for axis in "uv"),
        *("light_x", "light_y", "light_z", "decode_ms", "inference_ms", "error"),
        *("outside_trained_range", "status"),
    )
    opening = header = (",".join(columns) + "\n").encode()

    def encode(self, result: ImageResult) -> bytes:
        text = io.StringIO()
        rows = csv.writer(text, lineterminator="\n")
        start = (self.key(result.image), result.width, result.height, result.model, result.version)
        error = " ".join(result.error.split())
        end = (*_padded(result.light, 3), _rounded(result.decode_ms), _rounded(result.inference_ms), error)
        for index, detection in enumerate(result.detections or [None]):
            rows.writerow((*start, index, *_detection_cells(detection), *end, *_last_cells(detection)))
        return text.getvalue().encode(errors="surrogateescape")

    def key(self, image: str) -> str:
        # one line a row, also for a file name that has a line break in it
        return image.replace("\r", "\\r").replace("\n", "\\n")

    def parse(self, line: bytes) -> Line:
        try:
            cells = next(csv.reader([line.decode(errors="surrogateescape")]))
        except csv.Error as exc:
            raise ValueError(str(exc)) from exc
        row = dict(zip(self.columns, cells, strict=True))
        model = (row["model"], int(row["version"]))
        return Line(row["image"], opens_image=int(row["detection"]) == 0, model=model, is_error=bool(row["error"]))


class Bop(ResultFormat):
    """The result file of the BOP challenge: one row a detection, millimetres, nothing for an image without any.

    The format names neither the image's path nor the model. Scene and image come from the path, which must be BOP's own
    ``<scene>/rgb/<image>.png``; the time of a row is that of its whole image, as the challenge asks.

    Args:
        object_ids: BOP's number of every object that the model can find.
    """

    opening = header = b"scene_id,im_id,obj_id,score,R,t,time\n"
    has_line_for_every_image = False

    def __init__(self, object_ids: Mapping[str, int]) -> None:
        self._object_ids = dict(object_ids)

    def lines(self, results: Sequence[ImageResult]) -> ImageLines:
        """Format the lines of an image; its models run one after the other, and its time is the sum of theirs."""
        decode_ms = sum(result.decode_ms or 0.0 for result in results)
        inference_ms = sum(result.inference_ms or 0.0 for result in results)
        return super().lines([replace(result, decode_ms=decode_ms, inference_ms=inference_ms) for result in results])

    def encode(self, result: ImageResult) -> bytes:
        key = self.key(result.image)
        seconds = ((result.decode_ms or 0.0) + (result.inference_ms or 0.0)) / 1000
        rows = []
        for detection in result.detections:
            rotation = " ".join(f"{value:.9g}" for value in detection.rotation)
            translation_mm = " ".join(f"{1000 * value:.9g}" for value in detection.translation_m)
            score, number = f"{detection.confidence:.7g}", self._object_ids[detection.object]
            rows.append(f"{key},{number},{score},{rotation},{translation_mm},{seconds:.6f}\n")
        return "".join(rows).encode()

    def key(self, image: str) -> str:
        """The line's key ``scene,image``.

        Raises:
            UsageError: The path has no such numbers in it.
        """
        path = PurePath(image)
        folders = path.parent.parts
        if len(folders) < 2 or not (folders[-2].isdecimal() and path.stem.isdecimal()):
            raise UsageError(
                f"--format bop: {image!r} does not say its scene and image; expected <scene>/rgb/<image>.png as BOP "
                "lays them out, with numbers for both. Use --format jsonl or csv for other folders."
            )
        return f"{int(folders[-2])},{int(path.stem)}"

    def parse(self, line: bytes) -> Line:
        scene, image, number, *rest = line.decode("ascii").split(",")
        if len(rest) != 4:
            raise ValueError(f"{3 + len(rest)} columns")
        if int(number) not in self._object_ids.values():
            raise ValueError(f"object id {number}, which is none of those looked for now")
        # the format has no mark for the first row of an image: the file's reader sees the key change
        return Line(f"{int(scene)},{int(image)}", opens_image=False)


def _detection_cells(detection: Detection | None) -> Iterator[object]:
    """The columns of one detection; empty for None."""
    found = Detection() if detection is None else detection
    yield found.object
    yield "" if detection is None else round(found.confidence, 6)
    yield from _padded(found.translation_m, 3)
    yield from _padded(found.rotation, 9)
    yield from _padded(found.quaternion_xyzw, 4)
    yield from _padded(found.color, 3)
    yield from _padded([finite(value) for value in found.box_px], 16)


def _last_cells(detection: Detection | None) -> tuple[str, str]:
    """The last columns, as JSON writes them; empty for None."""
    if detection is None:
        return "", ""
    return json.dumps(detection.outside_trained_range), STATUS.get(detection.status, "")


def _padded(values: Sequence[float | None], length: int) -> list[float | None]:
    """The values, or that many empty cells where there are none."""
    return list(values) or [None] * length


def _rounded(milliseconds: float | None) -> float | None:
    return None if milliseconds is None else round(milliseconds, 3)
