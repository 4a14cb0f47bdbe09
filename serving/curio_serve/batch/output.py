"""Chooses the result file of a call, and its format."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from curio_serve.batch.arguments import DetectArguments
from curio_serve.batch.checks import refuse_images
from curio_serve.batch.estimators import Estimator
from curio_serve.batch.images.remote_files import is_url
from curio_serve.batch.images.source_image import SourceImage
from curio_serve.batch.images.sources import is_recording, names_recordings
from curio_serve.batch.results.formats import Bop, Csv, JsonLines, ResultFormat
from curio_serve.batch.results.result_file import ResultFile, values_of
from curio_serve.batch.results.result_parts import ResultParts
from curio_serve.bop import bop_object_ids
from curio_serve.errors import CameraError, UsageError

if TYPE_CHECKING:
    from curio_serve.batch.results.recorded_poses import Detection3DArrays, PoseRecording


def result_format(arguments: DetectArguments, estimators: Sequence[Estimator]) -> "ResultFormat | Detection3DArrays":
    """The format of the results.

    Raises:
        UsageError: The call or a model does not fit the format.
    """
    if arguments.out is not None and is_recording(arguments.out):
        if is_url(arguments.out):
            raise UsageError(
                f"--out {arguments.out}: recordings are written to files alone; name one, or a folder of parts"
            )
        are_flat = any(not estimator.spec.camera.camera_matrix for estimator in estimators)
        if arguments.format != "jsonl" or not all(map(names_recordings, arguments.images)) or are_flat:
            raise UsageError(
                f"--out {arguments.out} writes vision_msgs/Detection3DArray: for poses in space, images of recordings "
                "(.mcap) alone, and no --format"
            )
        from curio_serve.batch.results.recorded_poses import Detection3DArrays

        return Detection3DArrays([kind for estimator in estimators for kind in estimator.spec.objects])
    if arguments.format == "jsonl":
        return JsonLines(arguments.changed_options)
    if arguments.format == "csv":
        return Csv()
    for estimator in estimators:
        if not estimator.spec.camera.camera_matrix:
            raise UsageError(f"--format bop is for poses in space; the model's world {estimator.spec.world!r} is flat")
    names = dict.fromkeys(kind.name for estimator in estimators for kind in estimator.spec.objects)
    return Bop(bop_object_ids(list(names), arguments.obj_id))


def open_output(
    arguments: DetectArguments, form: "ResultFormat | Detection3DArrays", estimators: Sequence[Estimator]
) -> "ResultFile | ResultParts | PoseRecording":
    """Open the file or folder that ``--out`` names, or standard output.

    Raises:
        UsageError: It is one of the images, a recording that exists, a folder that holds something else, or a URL that
            cannot be written to.
        OutputError: It cannot be written.
        Unavailable: The object store does not answer.
    """
    refuse_images(arguments)
    if isinstance(form, ResultFormat):
        names = [(estimator.name, estimator.version) for estimator in estimators]
        if arguments.out is not None and is_url(arguments.out):
            camera_of = _camera_of(estimators)
            return ResultParts(arguments.out, form, names, overwrite=arguments.overwrite, camera_of=camera_of)
        path = None if arguments.out is None else Path(arguments.out)
        return ResultFile(path, form, names, overwrite=arguments.overwrite, camera_of=_camera_of(estimators))
    from curio_serve.batch.results.recorded_poses import PoseRecording  # of an extra

    assert arguments.out is not None
    return PoseRecording(Path(arguments.out), overwrite=arguments.overwrite)


def _camera_of(estimators: Sequence[Estimator]) -> Callable[[SourceImage], Sequence[float]]:
    """K and distortion of an image in the camera file of a call, or in its recording; none where neither has any."""
    cameras = next((estimator.settings.cameras for estimator in estimators), None)

    def camera(image: SourceImage) -> Sequence[float]:
        if cameras is None:
            return () if image.camera is None else values_of(image.camera)
        with suppress(CameraError):  # answering the image reports that
            return values_of(cameras.camera_for(image.numbered_name))
        return ()

    return camera
