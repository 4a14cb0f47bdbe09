"""``curio-detect --rig``: detects in the images that several cameras took at the same instant."""

import os
import time
from collections.abc import Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

from curio_proto.v1.detector_pb2 import DetectResponse

from curio_serve.batch.arguments import DetectArguments
from curio_serve.batch.checks import check_distinct, named_recordings, refuse_images
from curio_serve.batch.images.parallel import in_order
from curio_serve.batch.images.remote_files import is_url
from curio_serve.batch.images.source_image import SourceImage, Topics
from curio_serve.batch.images.sources import PassedOver, images
from curio_serve.batch.instants import Instants, RigImage, refuse_other_images
from curio_serve.batch.progress import Progress, say
from curio_serve.batch.results.formats import ImageLines, ImageResult, JsonLines
from curio_serve.batch.results.result_file import ResultFile, values_of
from curio_serve.errors import ArgumentError, CameraError, ImageError, InternalError, UsageError
from curio_serve.imaging import image as decoding
from curio_serve.imaging.view import searched_fraction
from curio_serve.models.detector import Detector
from curio_serve.models.model import Model, answering, canonical_camera
from curio_serve.models.model_check import ChildCheck
from curio_serve.models.model_folder import open_model
from curio_serve.models.runtime import Runtime, read_providers
from curio_serve.rigs.detect_views import RigView, detect_views
from curio_serve.rigs.rig import RigCamera, read_rig_file

_OF_ONE_INSTANT = (ImageError, CameraError, ArgumentError, InternalError)


class RigEstimator:
    """Detects in the images of an instant with one model on this machine; safe to share between threads."""

    def __init__(self, model: Model, cameras: Sequence[RigCamera], min_confidence: float, most: int | None) -> None:
        self._model, self._detector, self._cameras = model, Detector(model), cameras
        self._min_confidence, self._most = min_confidence, most
        self._canonical = canonical_camera(model.spec, model.name)

    def __call__(self, instant: RigImage) -> ImageResult:
        """The poses in the rig's frame, or what is wrong with an image."""
        begun = time.perf_counter()
        names = tuple(image.name for image in instant.images)
        try:
            decoded = [self._view(*pair) for pair in zip(instant.images, self._cameras, strict=True)]
            views = [view for view, _ in decoded]
            decoded_s, results = time.perf_counter(), DetectResponse().results
            detect_views(
                self._detector,
                views,
                min_confidence=self._min_confidence,
                max_detections=self._most,
                results=results,
            )
        except _OF_ONE_INSTANT as exc:
            return ImageResult(names[0], self._model.name, self._model.version, error=str(exc), views=names)
        return ImageResult(
            names[0],
            self._model.name,
            self._model.version,
            *views[0].size,
            views[0].camera.matrix.ravel().tolist(),
            results,
            1e3 * (decoded_s - begun),
            1e3 * (time.perf_counter() - decoded_s),
            is_turned=any(is_turned for _, is_turned in decoded),
            views=names,
            cam_from_rig=views[0].cam_from_rig.ravel().tolist(),
            distortion=views[0].camera.distortion,
            searched=min(searched_fraction(view.camera, self._canonical, *view.size) for view in views),
        )

    def _view(self, image: SourceImage, of: RigCamera) -> tuple[RigView, bool]:
        """What a camera sees, and whether EXIF asks for a rotation, which is not applied."""
        if image.pixels is not None:
            of.camera.check_frame(image.pixels.shape[1], image.pixels.shape[0])
            return RigView(image.pixels, of.camera, of.cam_from_rig), False
        try:
            data = image.read()
            header = decoding.open_header(data)
            reduction = self._detector.reduction(of.camera, header.width, header.height)
            frame = decoding.decode(data, header=header, max_reduction=reduction)
        except ImageError as exc:
            raise ImageError(f"{image.name}: {exc}") from exc
        of.camera.check_frame(frame.width, frame.height)
        return RigView(frame.pixels, of.camera, of.cam_from_rig, frame.reduction), header.orientation > 1


def read_rig(arguments: DetectArguments, models: Sequence[str]) -> list[RigCamera]:
    """The cameras of a call.

    Raises:
        UsageError: The file describes no rig, or the call has an option that is for one camera.
    """
    assert arguments.rig is not None
    given = {
        "--camera": arguments.camera,
        "--overlays": arguments.overlays,
        "--ray": arguments.ray,
        "--video": arguments.video,
        "--track": arguments.track,
        "--exif-rotation": arguments.exif_rotation,
        "--max-instances": arguments.max_instances,
        "--reads": arguments.reads != 1,
        "--plane": arguments.plane,
        "--refine": arguments.refine,
        "--mesh": arguments.mesh,
        "--mesh-unit": arguments.mesh_unit,
    }
    if wrong := [flag for flag, value in given.items() if value]:
        raise UsageError(f"--rig and {wrong[0]} do not go together: the rig's file has the cameras; leave one out")
    out = arguments.out or ""
    if arguments.format != "jsonl" or out.lower().endswith(".mcap") or is_url(out):
        raise UsageError("--rig writes JSON Lines into a file; leave out --format, and name --out so")
    if remote := [model for model in models if not os.path.exists(model)]:
        raise UsageError(f"--rig: {remote[0]} is behind a server; name a model on this machine, or set `views`")
    try:
        cameras = read_rig_file(Path(arguments.rig))
    except CameraError as exc:
        raise UsageError(f"--rig: {exc}") from exc
    if len(arguments.images) != len(cameras):
        names = ", ".join(camera.name for camera in cameras)
        raise UsageError(
            f"--rig {arguments.rig} has {len(cameras)} cameras ({names}), found {len(arguments.images)} IMAGES; "
            "expected a folder, glob or video of each camera, in the file's order"
        )
    return cameras


def answer_instant(estimators: Sequence[RigEstimator], form: JsonLines, instant: RigImage) -> ImageLines:
    """The lines of all models about an instant."""
    return form.lines([estimator(instant) for estimator in estimators])


def run_rig(arguments: DetectArguments, models: Sequence[str]) -> int:
    """Answer all instants; the exit status: 1 where one has no answer.

    Raises:
        UsageError: The call cannot be carried out.
        CurioError: The work as a whole failed.
    """
    cameras = read_rig(arguments, models)
    named_recordings(arguments)
    refuse_images(arguments)
    refuse_other_images(arguments.images, cameras)
    for model in models:
        ChildCheck()(Path(model))
    runtime = Runtime(read_providers(arguments.provider))
    try:
        opened = answering([open_model(model, runtime) for model in models], arguments.object_names)
    except ArgumentError as exc:
        raise UsageError(f"--objects: {exc}") from exc
    estimators = [RigEstimator(model, cameras, arguments.min_confidence, arguments.max_detections) for model in opened]
    names = [(model.name, model.version) for model in opened]
    check_distinct(names)
    form = JsonLines(arguments.changed_options)
    passed_over, topics = PassedOver(), Topics(arguments.topic, arguments.info_topic)
    path = None if arguments.out is None else Path(arguments.out)
    first = values_of(cameras[0].camera)
    with ResultFile(path, form, names, overwrite=arguments.overwrite, camera_of=lambda _: first) as output:
        taken = Instants([images([one], passed_over, topics) for one in arguments.images], arguments.images)
        remaining = output.unanswered(iter(taken))
        results = in_order(partial(answer_instant, estimators, form), remaining, arguments.jobs)
        with (
            closing(results),
            Progress(output.num_images, output.num_errors, is_shown=path is not None, are_compared=True) as progress,
        ):
            for result in results:
                output.write(result)
                progress.count(result)
        for line in (*passed_over.lines(), *taken.unpaired.lines()):
            say(line)
        if output.num_images == 0:
            raise UsageError(f"--rig: no images in {' '.join(arguments.images)}")
        progress.report(output.label)
        return 1 if output.num_errors else 0
