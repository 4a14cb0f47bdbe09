"""Writes scenes as one Rerun recording: photographs, cameras, boxes and confidence over time."""

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import rerun
from curio_serve.imaging.png import MAGIC
from scipy.spatial.transform import Rotation

from curio_train.drawing.photograph import is_stored_as_drawn, photograph_of
from curio_train.drawing.pictures import SceneContext
from curio_train.drawing.scenes import Scene
from curio_train.errors import DataError

TIMELINE = "image"
"""Name of the Rerun timeline that numbers the scenes from 0."""

_MEDIA_TYPES = {b"\xff\xd8\xff": "image/jpeg", MAGIC: "image/png"}  # of files that begin so: all that Rerun decodes


def write_recording(path: Path, scenes: Iterable[tuple[Scene, SceneContext]]) -> None:
    """Write a recording that Rerun opens; its root frame is the camera's (OpenCV).

    Args:
        path: The file.
        scenes: In the order of time, each with what has its meshes.

    Raises:
        DataError: An object has no mesh, a photograph cannot be read, or the file cannot be written.
    """
    try:
        with rerun.RecordingStream("curio") as recording:
            recording.save(path)
            recording.log("/", rerun.ViewCoordinates.RDF, static=True)
            for number, (scene, context) in enumerate(scenes):
                recording.set_time(TIMELINE, sequence=number)
                _log_camera(recording, scene)
                _log_objects(recording, scene, context)
    except (OSError, RuntimeError, ValueError) as exc:
        raise DataError(f"{path}: the recording cannot be written ({exc}); choose another --out") from exc


def _log_camera(recording: rerun.RecordingStream, scene: Scene) -> None:
    size = [scene.width, scene.height]
    recording.log("camera", rerun.Pinhole(image_from_camera=scene.camera_matrix, resolution=size))
    if scene.photograph is not None:
        recording.log("camera/image", _image(scene, scene.photograph))


def _image(scene: Scene, photograph: Path) -> Any:
    """The photograph's own file where Rerun can show it and it shows what a pinhole camera sees; else that, as JPEG."""
    if is_stored_as_drawn(scene):
        try:
            content = photograph.read_bytes()
        except OSError as exc:
            raise DataError(f"{photograph}: the photograph cannot be read ({exc.strerror})") from exc
        for beginning, media_type in _MEDIA_TYPES.items():
            if content.startswith(beginning):
                return rerun.EncodedImage(contents=content, media_type=media_type)
    return rerun.Image(photograph_of(scene)).compress()


def _log_objects(recording: rerun.RecordingStream, scene: Scene, context: SceneContext) -> None:
    """All boxes at once, so that an object that is not found any more goes; a curve of confidence an object."""
    corners = [context.mesh(item.kind).box_corners_m for item in scene.objects]
    low, high = (np.array([bound(box, axis=0) for box in corners]).reshape(-1, 3) for bound in (np.min, np.max))
    poses = [item.pose for item in scene.objects]
    centers = [pose.apply(middle) for pose, middle in zip(poses, (low + high) / 2, strict=True)]
    quaternions_xyzw = [Rotation.from_matrix(pose.rotation).as_quat() for pose in poses]
    boxes = rerun.Boxes3D(
        centers=np.reshape(centers, (-1, 3)),
        half_sizes=(high - low) / 2,
        quaternions=[rerun.Quaternion(xyzw=xyzw) for xyzw in quaternions_xyzw],
        labels=[f"{item.kind} {item.confidence:.2f}" for item in scene.objects],
    )
    recording.log("camera/boxes", boxes)
    seen: Counter[str] = Counter()
    for item in scene.objects:
        recording.log(f"confidence/{item.kind}/{seen[item.kind]}", rerun.Scalars(item.confidence))
        seen[item.kind] += 1
