"""Translates requests with the views of several cameras, and refuses requests that do not describe a rig."""

from collections.abc import Sequence

from curio_proto.v1.detector_pb2 import DetectRequest

from curio_serve.errors import ArgumentError, CameraMissing
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.image import Frame
from curio_serve.models.detector import Detector
from curio_serve.rigs.detect_views import RigView
from curio_serve.rigs.rig import LEAST_VIEWS, MOST_VIEWS, check_cam_from_rig

_NOT_WITH_VIEWS = ("encoded", "raw", "camera", "track", "max_instances", "reads", "plane")


def check_views(request: DetectRequest, num_models: int, most_runs: int) -> None:
    """Refuse requests that can be refused without work.

    Args:
        request: With views.
        num_models: That it names.
        most_runs: Of networks, for one request.

    Raises:
        ArgumentError: A wrong number of views, or what is for one camera beside them.
    """
    if not LEAST_VIEWS <= len(request.views) <= MOST_VIEWS:
        raise ArgumentError(f"views has {len(request.views)} entries; expected {LEAST_VIEWS} to {MOST_VIEWS}")
    if len(request.views) * num_models > most_runs:
        raise ArgumentError(
            f"{num_models} models times {len(request.views)} views are {num_models * len(request.views)} runs of a "
            f"network; at most {most_runs} are accepted (the larger of --max-models and --max-regions)"
        )
    given = [name for name in _NOT_WITH_VIEWS if request.HasField(name)]
    given += ["regions"] * bool(request.regions) + ["apply_exif_rotation"] * request.apply_exif_rotation
    if given:
        raise ArgumentError(f"the request has views and {', '.join(given)}; leave these out: each view has its own")


def refuse_many_pixels(views: Sequence[RigView], most: int) -> None:
    """Refuse views that need too much memory together.

    Args:
        views: As they are decoded, large JPEGs at a fraction of their size.
        most: Pixels.

    Raises:
        ArgumentError: They have more.
    """
    if (num_pixels := sum(view.pixels.shape[0] * view.pixels.shape[1] for view in views)) > most:
        raise ArgumentError(
            f"views up to views[{len(views) - 1}] have {num_pixels} pixels together; at most {most} are accepted for "
            "all views of a request (max-pixels): send smaller images, or JPEGs"
        )


def rig_view(
    request: DetectRequest, number: int, frame: Frame, camera: PinholeCamera | None, detectors: list[Detector]
) -> RigView:
    """A decoded view.

    Raises:
        CameraMissing: The view has no camera.
        CameraError: ``cam_from_rig`` is no rigid transform.
    """
    known = camera or detectors[0].model.camera.for_frame(frame.width, frame.height)
    if known is None:
        raise CameraMissing(f"views[{number}] has no camera; poses in a rig's frame need the camera matrix K of each")
    pose = check_cam_from_rig(list(request.views[number].cam_from_rig), f"views[{number}].cam_from_rig")
    return RigView(frame.pixels, known, pose, frame.reduction)
