"""Refuses calls of ``curio-detect`` that cannot be carried out, before any work."""

import os
from collections.abc import Sequence
from pathlib import Path

from curio_serve.batch.arguments import DetectArguments
from curio_serve.batch.estimators import Estimator
from curio_serve.batch.images.recordings import Recording
from curio_serve.batch.images.remote_files import is_url
from curio_serve.batch.images.source_image import Topics
from curio_serve.batch.images.sources import (
    ANY_TOPICS,
    IMAGE_SUFFIXES,
    STANDARD_INPUT,
    VIDEO_SUFFIXES,
    common_folder,
    is_recording,
    matching_paths,
    names_recordings,
)
from curio_serve.errors import CameraError, UsageError
from curio_serve.models.repeated import MAX_READS
from curio_serve.planes.camera_poses import CameraPoseFile
from curio_serve.planes.plane import FIND_PLANE

_READ = ("--camera", "--plane", "--rig", "--token-file", "--server-ca", "--tls-certificate", "--tls-key")
"""Flags of files that a call reads."""


def check_numbers(arguments: DetectArguments) -> None:
    """Refuse flags that contradict each other, and numbers out of range.

    Raises:
        UsageError: Says which.
    """
    if arguments.video is not None and (arguments.images or arguments.out or arguments.overlays or arguments.ray):
        raise UsageError("--video shows a video and writes nothing: leave out IMAGES, --out, --overlays and --ray")
    of_images = {
        "--track": arguments.track,
        "--format": arguments.format != DetectArguments.format,
        "--overwrite": arguments.overwrite,
        "--exif-rotation": arguments.exif_rotation,
    }
    if arguments.video is not None and (given := [flag for flag, is_given in of_images.items() if is_given]):
        raise UsageError(f"{given[0]} has no effect on --video, which reads each frame by itself; leave it out")
    where = arguments.host, arguments.port
    if arguments.video is None and where != (DetectArguments.host, DetectArguments.port):
        raise UsageError("--host and --port are of the page that --video makes; leave them out")
    if arguments.jobs < 1:
        raise UsageError(f"--jobs {arguments.jobs}: expected at least 1")
    if not 0 <= arguments.min_confidence <= 1:
        raise UsageError(f"--min-confidence {arguments.min_confidence}: expected 0 to 1")
    if arguments.max_detections is not None and arguments.max_detections < 1:
        raise UsageError(f"--max-detections {arguments.max_detections}: expected at least 1")
    if arguments.max_instances is not None and not 1 <= arguments.max_instances <= 16:
        raise UsageError(f"--max-instances {arguments.max_instances}: expected 1 to 16")
    if not 1 <= arguments.reads <= MAX_READS:
        raise UsageError(f"--reads {arguments.reads}: expected 1 to {MAX_READS}")
    if arguments.obj_id is not None and (arguments.format != "bop" or arguments.obj_id < 1):
        raise UsageError(f"--obj-id {arguments.obj_id}: expected a number from 1, together with --format bop")


def check_overlays(folder: Path, images: Sequence[str]) -> None:
    """Refuse drawings that would land on the images, or be taken for images by this run or the next.

    Raises:
        UsageError: They would, or the folder cannot be made.
    """
    target = Path(os.path.realpath(folder))
    if target == Path(os.path.realpath(common_folder(images))):  # below which drawings have the images' own names
        raise UsageError(
            f"--overlays {folder} is the folder of all images, which drawings would replace; choose another"
        )
    for argument in images:
        if is_url(argument):
            continue
        source = Path(os.path.realpath(common_folder([argument])))
        if target == source or (not os.path.isfile(argument) and argument != "-" and target.is_relative_to(source)):
            raise UsageError(f"--overlays {folder} lies within the images' own folder {source}; choose one outside it")
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as exc:
        raise UsageError(f"--overlays {folder}: cannot be made: {exc.strerror}") from exc


def named_recordings(arguments: DetectArguments) -> list[Recording]:
    """Open the recordings that a call names, so that a bad one is refused before any work.

    Raises:
        UsageError: One cannot be used, or the call chooses topics and names none.
    """
    topics = Topics(arguments.topic, arguments.info_topic)
    found = [path for argument in arguments.images for path in matching_paths(argument) if is_recording(path)]
    if not found and topics != ANY_TOPICS and STANDARD_INPUT not in arguments.images:
        raise UsageError("--topic and --info-topic are for recordings; found no .mcap among the images")
    return [Recording(path, topics) for path in found]


def check_camera(arguments: DetectArguments, estimator: Estimator, recordings: Sequence[Recording]) -> None:
    """Refuse images of an unknown camera where the model needs it; recordings have it in them.

    Raises:
        UsageError: The camera is missing, or the call has an option for poses in space and the model's world is flat.
    """
    canonical = estimator.canonical
    if arguments.max_instances is not None and canonical.matrix is None:
        raise UsageError(f"--max-instances is for poses in space; the world of {estimator.name} is flat")
    if arguments.camera is not None or canonical.matrix is None or canonical.is_default:
        return
    for recording in recordings:
        recording.refuse_without_info()
    if arguments.video is not None or not all(map(names_recordings, arguments.images)):
        raise UsageError(
            f"model {estimator.name} needs the intrinsics of the camera that took the images; give --camera FILE "
            "(camera JSON, BOP's camera.json or scene_camera.json, or YAML of OpenCV or ROS)"
        )


def check_plane(arguments: DetectArguments, estimator: Estimator) -> None:
    """Refuse a plane that a model has no use for, or that is not known in every image's camera.

    Raises:
        UsageError: Says why.
    """
    if arguments.plane is None:
        return
    if not estimator.spec.HasField("stable_poses"):
        raise UsageError(
            f"--plane: model {estimator.name} does not say how its objects stand; leave it out, or export the model's "
            "run again (of worlds that are flat, or whose parts all stand, none says it)"
        )
    poses = estimator.settings.plane
    most = arguments.track_objects if arguments.track else arguments.max_instances or 1
    if poses == FIND_PLANE and estimator.spec.num_slots == 1 and most == 1:
        raise UsageError(
            f"--plane objects: {estimator.name} finds one object in an image, which stands on any plane; give a file "
            f"of the plane, or look for several objects (--{'track-objects' if arguments.track else 'max-instances'})"
        )
    if isinstance(poses, CameraPoseFile):
        try:
            poses.refuse_impossible_planes()
        except CameraError as exc:
            raise UsageError(str(exc)) from exc
    if isinstance(poses, CameraPoseFile) and arguments.exif_rotation:
        raise UsageError(f"--plane {arguments.plane} is of the stored pixels' camera; leave out --exif-rotation")
    if isinstance(poses, CameraPoseFile) and poses.of_all is None and arguments.video is not None:
        raise UsageError(
            f'--plane {arguments.plane} has poses of named photographs; expected {{"cam_from_world": [4x4]}} of the '
            "camera that --video shows"
        )


def check_distinct(models: Sequence[tuple[str, int]]) -> None:
    """Refuse models whose results could not be told apart.

    Args:
        models: Name and version of each.

    Raises:
        UsageError: Two are the same.
    """
    if twice := next((one for number, one in enumerate(models) if one in models[:number]), None):
        name, version = twice
        raise UsageError(
            f"two models are {name}/{version}, and their results could not be told apart; give one another name"
        )


def refuse_server_flags(arguments: DetectArguments, models: Sequence[str]) -> None:
    """Refuse flags that are for a server where all models are on this machine.

    Raises:
        UsageError: There is such a flag; it is named.
    """
    for flag in ("server_ca", "tls_certificate", "tls_key", "token_file"):
        if (given := getattr(arguments, flag)) is not None and all(map(os.path.exists, models)):
            name = flag.replace("_", "-")
            raise UsageError(f"--{name} {given} is for a model on a server, HOST:PORT/NAME; leave it out")


def refuse_images(arguments: DetectArguments) -> None:
    """Refuse to write results over an image, a video, a recording, a model, or another file that the call reads.

    Raises:
        UsageError: ``--out`` is one.
    """
    out = arguments.out
    if out is None or is_url(out) or not os.path.exists(out):
        return
    paths = (path for name in arguments.images if not is_url(name) for path in matching_paths(name))
    if any(os.path.samefile(path, out) for path in paths):
        raise UsageError(f"--out {out} is one of the images; choose another file")
    read = {flag: getattr(arguments, flag.lstrip("-").replace("-", "_")) for flag in _READ}
    for flag, path in [*read.items(), *(("--mesh", mesh) for mesh in arguments.mesh)]:
        if path is not None and os.path.exists(path) and os.path.samefile(path, out):
            raise UsageError(f"--out {out} is the file of {flag}; choose another file")
    if os.path.isfile(out) and Path(out).suffix.lower() in IMAGE_SUFFIXES | VIDEO_SUFFIXES | {".onnx"}:
        raise UsageError(f"--out {out} is an image, a video or a model; choose another file")
