"""``curio-detect``: poses in many images, through a model on this machine or behind a server."""

import os
import shlex
import signal
import sys
from contextlib import closing
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from curio_serve.batch.arguments import DetectArguments
from curio_serve.command_line import parsed, stop_printing
from curio_serve.errors import ArgumentError, CameraError, CurioError, UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from curio_proto.v1.model_spec_pb2 import ModelSpec

    from curio_serve.batch.estimators import Estimator, Settings
    from curio_serve.batch.images.source_image import SourceImage
    from curio_serve.batch.progress import Progress
    from curio_serve.batch.results.formats import ImageLines, ResultFormat
    from curio_serve.batch.results.recorded_poses import Detection3DArrays, PoseRecording
    from curio_serve.batch.results.result_file import ResultFile
    from curio_serve.batch.results.result_parts import ResultParts
    from curio_serve.client import PoseClient
    from curio_serve.planes.camera_poses import GivenPlane


def main() -> NoReturn:
    """Entry point of the command."""
    arguments = parsed(DetectArguments, None, "curio-detect")
    # Both by name: a process started in the background inherits an ignored SIGINT, and Python then leaves it so.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _terminate)
    try:
        status = run(arguments)
    except BrokenPipeError:
        stop_printing()
        status = 1
    except CurioError as exc:
        print(f"curio-detect: error: {exc}", file=sys.stderr)
        status = exc.exit_status
    except KeyboardInterrupt as exc:
        print(f"\ncurio-detect: stopped. {_how_to_go_on(arguments)}", file=sys.stderr)
        status = 128 + (exc.args[0] if exc.args else signal.SIGINT)
    sys.exit(status)


def run(arguments: DetectArguments) -> int:
    """Run the command and return the exit status: 1 if an image has no answer.

    Raises:
        UsageError: The call cannot be carried out.
        CurioError: The work as a whole failed.
    """
    # Heavy packages only now: --help does without.
    import cv2

    from curio_serve.batch.checks import check_camera, check_numbers, check_plane, named_recordings
    from curio_serve.batch.cluster import over_cluster
    from curio_serve.batch.images.parallel import in_order
    from curio_serve.batch.images.read_ahead import read_ahead
    from curio_serve.batch.images.remote_files import is_url
    from curio_serve.batch.images.source_image import Topics
    from curio_serve.batch.images.sources import STANDARD_INPUT, PassedOver, check_arguments, images
    from curio_serve.batch.output import open_output, result_format
    from curio_serve.batch.progress import say
    from curio_serve.batch.refinement import outlining, refining
    from curio_serve.batch.rig_images import run_rig
    from curio_serve.batch.tracked import check_tracking, from_the_first, timed
    from curio_serve.models.model_check import ChildCheck

    models, arguments = _models_first(arguments)
    check_numbers(arguments)
    arguments = check_tracking(arguments, models)
    if arguments.video is None:
        check_arguments(arguments.images)
    cv2.setNumThreads(1)  # the images are what runs in parallel
    if arguments.rig is not None:
        return run_rig(arguments, models)
    settings = _settings(arguments)
    for model in models:
        if os.path.exists(model):
            ChildCheck()(Path(model))
    estimators, recordings = _estimators(arguments, models, settings), named_recordings(arguments)
    refiner = refining(arguments, models[0], estimators)
    outlining(arguments, models, estimators)
    for estimator in estimators:
        check_camera(arguments, estimator, recordings)
        check_plane(arguments, estimator)
    if arguments.video is not None:
        return _live(arguments, estimators)
    form = result_format(arguments, estimators)
    passed_over, topics = PassedOver(), Topics(arguments.topic, arguments.info_topic)
    with open_output(arguments, form, estimators) as output:
        remaining = output.unanswered(images(arguments.images, passed_over, topics))
        if arguments.track:
            remaining = timed(from_the_first(output, remaining), arguments.frame_rate)
        if arguments.ray is None:
            may_be_remote = any(name == STANDARD_INPUT or is_url(name) for name in arguments.images)
            content = read_ahead(remaining) if may_be_remote else remaining
            results = in_order(partial(_answer, estimators, form), content, arguments.jobs)
        else:  # other nodes have another working folder
            there = [os.path.abspath(model) if os.path.exists(model) else model for model in models]
            placed = replace(arguments, mesh=tuple(mesh.absolute() for mesh in arguments.mesh))
            results = over_cluster(arguments.ray, partial(_answering, placed, there, settings, form), remaining)
        with (
            closing(results),
            _progress(arguments, output) as progress,
        ):
            for result in results:
                output.write(result)
                progress.count(result)
        for line in passed_over.lines():
            say(line)
        if refiner is not None:
            say(f"refined {refiner.num_refined} of {refiner.num_detections} poses; the others stay as detected")
        if output.num_images == 0:
            raise UsageError(
                f"no images in {' '.join(arguments.images)}; looked for .jpg, .jpeg, .png and .webp in folders, "
                "sub-folders included"
            )
        progress.report(output.label)
        return 1 if output.num_errors else 0


def _models_first(arguments: DetectArguments) -> tuple[tuple[str, ...], DetectArguments]:
    """Split a call into its models, and a call that names only images."""
    from curio_serve.batch.named_models import split_models

    models, images = split_models(arguments.model, arguments.images)
    return models, replace(arguments, images=images)


def _live(arguments: DetectArguments, estimators: "Sequence[Estimator]") -> int:
    if len(estimators) > 1:
        raise UsageError(f"--video shows the detections of one model, found {len(estimators)}; name one")
    (estimator,) = estimators
    if find_spec("viser") is None:
        raise UsageError("--video needs the extra view: pip install 'curio-pose[view]'")
    from curio_serve.batch.live import show_live

    assert arguments.video is not None
    return 0 if show_live(estimator, arguments.video, arguments.host, arguments.port) else 1


def _settings(arguments: DetectArguments) -> "Settings":
    from curio_serve.batch.checks import check_overlays
    from curio_serve.batch.estimators import Settings
    from curio_serve.batch.images.sources import common_folder
    from curio_serve.imaging.camera_files import read_camera_file

    try:
        cameras = None if arguments.camera is None else read_camera_file(arguments.camera)
    except CameraError as exc:
        raise UsageError(f"--camera: {exc}") from exc
    if arguments.overlays is not None:
        check_overlays(arguments.overlays, arguments.images)
    return Settings(
        cameras,
        arguments.min_confidence,
        arguments.max_detections,
        arguments.exif_rotation,
        arguments.overlays and Path(os.path.abspath(arguments.overlays)),
        common_folder(arguments.images or ["."]),
        arguments.track_objects if arguments.track else None,
        arguments.max_instances,
        arguments.reads,
        arguments.object_names,
        _plane(arguments),
    )


def _progress(arguments: DetectArguments, output: "ResultFile | ResultParts | PoseRecording") -> "Progress":
    from curio_serve.batch.progress import Progress

    before = output.num_images, output.num_errors
    return Progress(*before, is_shown=arguments.out is not None, are_compared=arguments.format == "jsonl")


def _plane(arguments: DetectArguments) -> "GivenPlane":
    from curio_serve.planes.camera_poses import CameraPoseFile

    try:
        found = CameraPoseFile.named(arguments.plane)
    except CameraError as exc:
        raise UsageError(str(exc)) from exc
    # Absolute, because other nodes of a cluster have another working folder.
    return replace(found, file=found.file.absolute()) if isinstance(found, CameraPoseFile) else found


def _estimators(arguments: DetectArguments, models: "Sequence[str]", settings: "Settings") -> "list[Estimator]":
    """An estimator for each model, on this machine or behind a server."""
    from curio_serve.batch.checks import check_distinct, refuse_server_flags
    from curio_serve.batch.estimators import LocalEstimator, RemoteEstimator
    from curio_serve.batch.named_models import SERVED_MODEL
    from curio_serve.models.model_folder import open_model
    from curio_serve.models.runtime import Runtime, read_providers
    from curio_serve.models.spec import check_known

    found: list[Estimator] = []
    specs: list[ModelSpec] = []  # with all of a model's objects, not only those that are asked for
    refuse_server_flags(arguments, models)
    for model in models:
        if os.path.exists(model):
            opened = open_model(model, Runtime(read_providers(arguments.provider)))
            specs.append(opened.spec)
            _check_objects(opened.spec, model, settings)
            try:
                found.append(LocalEstimator(opened, settings))
            except ArgumentError as exc:
                raise UsageError(f"--reads: {exc}") from exc
            continue
        served = SERVED_MODEL.fullmatch(model)
        if served is None:
            if SERVED_MODEL.fullmatch(f"{model.rstrip('/')}/NAME"):
                raise UsageError(f"MODEL {model}: which model of that server? Expected {model.rstrip('/')}/NAME")
            raise UsageError(
                f"MODEL {model}: no such folder or file, nor HOST:PORT/NAME of a server; expected a folder that "
                "curio-export wrote, such as models/ape"
            )
        if arguments.provider != DetectArguments.provider:
            raise UsageError(f"--provider {arguments.provider}: found a model on a server, which chooses its own")
        found.append(RemoteEstimator(_client(arguments, served["address"]), served["model"], settings))
        specs.append(found[-1].spec)
        _check_objects(found[-1].spec, model, settings)
    check_distinct([(estimator.name, estimator.version) for estimator in found])
    try:
        check_known(specs, settings.objects)
    except ArgumentError as exc:
        raise UsageError(f"--objects: {exc}") from exc
    return found


def _check_objects(spec: "ModelSpec", model: str, settings: "Settings") -> None:
    from curio_serve.models.spec import wanted_slots

    try:
        wanted_slots(spec, model, settings.objects)
    except ArgumentError as exc:
        raise UsageError(f"--objects: {exc}") from exc


def _answering(
    arguments: DetectArguments,
    models: "Sequence[str]",
    settings: "Settings",
    form: "ResultFormat | Detection3DArrays",
) -> "Callable[[SourceImage], ImageLines]":
    """Build the function that answers images in another process."""
    from curio_serve.batch.refinement import outlining

    estimators = _estimators(arguments, models, settings)
    outlining(arguments, models, estimators)
    return partial(_answer, estimators, form)


def _answer(
    estimators: "Sequence[Estimator]", form: "ResultFormat | Detection3DArrays", image: "SourceImage"
) -> "ImageLines":
    """Answer an image and format its lines, both in the worker: one thread for all lines would be too slow."""
    from curio_serve.batch.estimators import answers

    return form.lines(answers(estimators, image))


def _client(arguments: DetectArguments, address: str) -> "PoseClient":
    from curio_serve.client import PoseClient, Tls
    from curio_serve.files import read_given

    tls = None
    if arguments.server_ca is not None:
        tls = Tls(arguments.server_ca, arguments.tls_certificate, arguments.tls_key)
    elif arguments.tls_certificate is not None or arguments.tls_key is not None:
        raise UsageError("--tls-certificate and --tls-key need --server-ca: they are shown over TLS only")
    try:
        token = "" if arguments.token_file is None else read_given(arguments.token_file).decode("utf-8").strip()
    except (OSError, UnicodeDecodeError) as exc:
        raise UsageError(f"--token-file {arguments.token_file} cannot be read: {exc}") from exc
    # Patient: a busy or restarting server shall not end a run over many images.
    return PoseClient(address, timeout_s=60.0, max_attempts=50, tls=tls, token=token)


def _how_to_go_on(arguments: DetectArguments) -> str:
    if arguments.video is not None:
        return "The page is gone with it."
    if arguments.track:
        return "Following cannot go on in the middle; type the same again, with --overwrite where --out names a file."
    if arguments.out is None:
        return "Standard output cannot be gone on with; give --out FILE to be able to."
    if arguments.out.lower().endswith(".mcap"):
        return f"{arguments.out} holds the answers so far; a recording cannot be gone on with, --overwrite replaces it."
    command = [part for part in sys.argv[1:] if part not in ("--overwrite", "--no-overwrite")]
    return f"{arguments.out} holds complete images; to go on: {shlex.join(['curio-detect', *command])}"


def _terminate(number: int, _: object) -> NoReturn:
    raise KeyboardInterrupt(number)
