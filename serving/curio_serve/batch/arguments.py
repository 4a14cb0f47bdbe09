"""The arguments of ``curio-detect``."""

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from curio_serve.cores import num_cores
from curio_serve.errors import UsageError

_OF_ANSWERS = (
    *("objects", "min_confidence", "max_detections", "max_instances"),
    *("reads", "plane", "refine", "exif_rotation"),
    *("track", "track_objects", "frame_rate"),
)
_FILES_OF_ANSWERS = ("plane", "rig")  # whose content may be another one the next time


@dataclass(frozen=True)
class DetectArguments:
    """Find a model's objects in images and write one JSON object an image, in the order of the images.

    Several models may stand before the images, or a folder of models: each image then has a line of each model.

    Poses are cam_from_obj in metres, in OpenCV's camera frame (x right, y down, z forward). An image that cannot be
    read gets a line with its error, stops nothing, and makes the exit status 1. After a stop of any kind, run the same
    command again: it goes on after the last complete image.
    """

    model: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MODEL")]
    """Model folder (its latest version), version folder, .onnx file, folder of models, or hf://ORG/NAME[@REVISION] of a
    hub; if no such path, a server's HOST:PORT/NAME."""
    images: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="IMAGES...")]
    """Files, folders (and those below; of a BOP scene its photographs), globs, videos, recordings (MCAP with ROS 2
    messages), URLs (s3://…, gs://…, https://…; .txt: a list of images), or - for a list on stdin."""
    video: str | None = None
    """Show detections live in the browser instead: a camera's number, a video file, or a URL such as rtsp://…."""
    host: str = "127.0.0.1"
    """Address that --video listens on; whoever reaches it sees the frames."""
    port: int = 8080
    """Port that --video listens on."""
    camera: Path | None = None
    """Camera file: camera JSON, BOP's camera.json or scene_camera.json, or YAML of OpenCV or ROS. 2D worlds need
    none."""
    rig: Path | None = None
    """Several cameras: a file of --calibrate --rig-out. IMAGES are then a folder or video of each, in its order, and
    poses are in the rig's frame."""
    topic: str | None = None
    """Topic of a recording's images. None: the only one that there is."""
    info_topic: str | None = None
    """Topic of their CameraInfo, which says K unless --camera does. None: camera_info beside the images."""
    out: Annotated[str | None, tyro.conf.arg(metavar="FILE")] = None
    """Result file. One that exists is gone on with, where it is of the same model and images. None: stdout. FILE.mcap,
    for recordings: vision_msgs/Detection3DArray. s3://… and gs://…: a folder of parts."""
    overwrite: bool = False
    """Replace the result file instead."""
    format: Literal["jsonl", "csv", "bop"] = "jsonl"
    """JSON Lines; CSV, a row a detection; BOP's results in millimetres, for images <scene>/rgb/<image>.png."""
    obj_id: int | None = None
    """Object id in BOP's results. None: that of the LineMOD class the object is named after."""
    overlays: Path | None = None
    """Folder for pictures with contours and axes drawn in, laid out like the images; with boxes where no mesh is known
    (--mesh)."""
    objects: str | None = None
    """Kinds of objects to look for, with commas: ape,can. None: all that the model knows. A model of several objects
    spends no time on the others."""
    min_confidence: float = 0.0
    """Leave out detections below, 0 to 1. Those below the model's own threshold say that they are unsure."""
    max_detections: int | None = None
    """Keep that many of an image, the most confident. None: all."""
    max_instances: int | None = None
    """Find up to that many of each kind of object, at a further run of the network each; of parts on a plane, which one
    run finds together, keep that many. None: what one run gives."""
    reads: int = 1
    """Read each image that many times, 1 to 9, through slightly turned and zoomed cameras, and answer what most reads
    agree on: better poses in photographs, in as many times the time."""
    plane: Annotated[str | None, tyro.conf.arg(metavar="FILE|objects")] = None
    """Objects stand on this plane: move each pose along its line of sight until it does. A file of curio-train capture
    --calibrate, or objects: the plane on which most of an image's objects stand."""
    track: bool = False
    """Follow objects through the frames of each video, or of each folder's images in order: JSON Lines have tracks."""
    track_objects: int = 1
    """With --track: most objects of each kind at a time."""
    frame_rate: float = 30.0
    """With --track: of a folder's images and of videos that say none, frames/s."""
    refine: tyro.conf.FlagCreatePairsOff[bool] = False
    """Improve each pose by render-and-compare with the object's mesh: seconds a pose, and the extra train."""
    mesh: tyro.conf.UseAppendAction[tuple[Path, ...]] = ()
    """Mesh for --refine and --overlays; of several objects, once for each, or the folder of all files. None: those
    of the run in whose folder the model lies."""
    mesh_unit: Literal["m", "cm", "mm", "inch"] | None = None
    """Unit of --mesh; the file's own, or metres, unless given. BOP's meshes are in mm."""
    exif_rotation: bool = False
    """Turn images as EXIF says, and K with them. Otherwise pixels are taken as stored, to which K belongs."""
    jobs: int = num_cores()
    """Images worked on at the same time; by default the number of cores that there are for it."""
    provider: str = "cpu"
    """onnxruntime's execution providers by preference, with commas: cpu, openvino, cuda, tensorrt, coreml or others."""
    ray: str | None = None
    """Do it on a Ray cluster: HOST:PORT, auto for the one this machine is in, local for this machine's processors."""
    token_file: Path | None = None
    """File with the bearer token that the server asks for."""
    server_ca: Path | None = None
    """Authority (PEM) that signed the server's certificate; turns TLS on."""
    tls_certificate: Path | None = None
    """Our own certificate (PEM), for a server that asks for one."""
    tls_key: Path | None = None
    """Key of our certificate (PEM)."""

    @property
    def object_names(self) -> tuple[str, ...]:
        """The names in ``--objects``.

        Raises:
            UsageError: One of them is empty.
        """
        names = [] if self.objects is None else [name.strip() for name in self.objects.split(",")]
        if not all(names):
            raise UsageError(f"--objects {self.objects}: expected names with commas between them, such as ape,can")
        return tuple(dict.fromkeys(names))

    @property
    def changed_options(self) -> dict[str, object]:
        """The options that change answers, where they are not the default: each line of a result file has them."""
        given = {name: getattr(self, name) for name in _OF_ANSWERS}
        changed = {name: value for name, value in given.items() if value != getattr(DetectArguments, name)}
        for name in _FILES_OF_ANSWERS:
            file = getattr(self, name)
            if file is not None and os.path.isfile(file):
                changed[f"{name}_sha256"] = hashlib.sha256(Path(file).read_bytes()).hexdigest()[:16]
        return changed
