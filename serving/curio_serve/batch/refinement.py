"""What ``curio-detect`` does with an object's mesh, which the extra ``train`` reads.

``--refine`` improves poses by render-and-compare; ``--overlays`` draws the mesh's contour in place of a box. Serving
does without renderer and mesh files. It asks for the functions below by name, and only where a call wants them.
"""

import importlib
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np
from curio_proto.v1.detector_pb2 import Detection
from curio_proto.v1.model_spec_pb2 import ModelSpec

from curio_serve.batch.arguments import DetectArguments
from curio_serve.batch.estimators import Estimator, Seen
from curio_serve.batch.images.source_image import SourceImage
from curio_serve.errors import UsageError
from curio_serve.imaging.camera import PinholeCamera

_MODULE, _REFINER, _SURFACES = "curio_train.commands.refine", "refiner", "surfaces"


class Refiner(Protocol):
    """Improves detections in place; safe to share between threads."""

    num_detections: int
    """Number of detections so far."""
    num_refined: int
    """Number of detections whose refined pose matches the frame better."""

    def __call__(
        self, pixels: np.ndarray, camera: PinholeCamera, detections: Sequence[Detection], light: Sequence[float]
    ) -> None:
        """Refine the poses of one frame.

        Args:
            pixels: uint8 RGB [height, width, 3].
            camera: Of the frame.
            detections: Of it; their poses and boxes are replaced where a better pose is found.
            light: [3] in the frame's camera, where the model says it.
        """


def load_refiner(spec: ModelSpec, model: str, meshes: Sequence[Path], unit: str | None) -> Refiner:
    """Render-and-compare for the objects of a model.

    Args:
        spec: Of the model.
        model: As it was named: meshes are looked for where it lies.
        meshes: The objects' files, or folders of them; none: those of the run which the model lies in.
        unit: Of the meshes' coordinates; None: the files' own, or metres.

    Raises:
        UsageError: The extra is not installed, an object has no mesh, or it is another object's.
    """
    try:
        make = getattr(importlib.import_module(_MODULE), _REFINER)
        made: Refiner = make(spec, model, meshes, unit)
    except ImportError as exc:
        raise UsageError(f"--refine needs the extra train ({exc}): pip install 'curio-pose[train]'") from exc
    return made


class RefiningEstimator(Estimator):
    """Another estimator's answers with refined poses."""

    def __init__(self, estimator: Estimator, refiner: Refiner) -> None:
        super().__init__(estimator.name, estimator.version, estimator.spec, estimator.settings)
        self._estimator, self._refiner = estimator, refiner

    def _look(self, image: SourceImage, data: bytes, camera: PinholeCamera | None) -> Seen:
        seen = self._estimator.look(image, data)
        if seen.camera is None:
            return seen
        started = time.perf_counter()
        for result in seen.results:
            if result.detections:
                pixels = (seen.frame or self._frame(image, data)).pixels
                self._refiner(pixels, seen.camera, result.detections, result.light)
        return replace(seen, inference_ms=seen.inference_ms + 1000 * (time.perf_counter() - started))


def refining(arguments: DetectArguments, model: str, estimators: list[Estimator]) -> Refiner | None:
    """Let the one estimator refine its answers, where the call wants that.

    Raises:
        UsageError: The call names several models, a cluster, a video, tracks or a plane; or as of :func:`load_refiner`.
    """
    if not arguments.refine:
        return None
    if arguments.ray is not None or arguments.video is not None or arguments.track:
        raise UsageError("--refine takes seconds a pose, in this process alone: leave out --ray, --video and --track")
    if arguments.plane is not None:
        raise UsageError("--refine and --plane both correct distances, each in its own way; leave one of them out")
    if len(estimators) != 1:
        raise UsageError(f"--refine needs the meshes of one model, found {len(estimators)} models; name one")
    refiner = load_refiner(estimators[0].spec, model, arguments.mesh, arguments.mesh_unit)
    estimators[0] = RefiningEstimator(estimators[0], refiner)
    return refiner


def outlining(arguments: DetectArguments, models: Sequence[str], estimators: Sequence[Estimator]) -> None:
    """Let estimators draw contours where the call wants drawings and the mesh is known.

    Raises:
        UsageError: The call names a mesh for nothing or for several models, it cannot be read, or the extra is missing.
    """
    if not arguments.mesh and arguments.mesh_unit is not None:
        raise UsageError("--mesh-unit is for --mesh; name the mesh, too")
    if arguments.mesh and arguments.overlays is None and not arguments.refine:
        raise UsageError("--mesh is for --refine and --overlays; add one of them, or leave it out")
    if arguments.overlays is None:
        return
    if arguments.mesh and len(estimators) != 1:
        raise UsageError(
            f"--mesh is for the objects of one model, found {len(estimators)} models; name one, or leave it out"
        )
    for model, estimator in zip(models, estimators, strict=True):
        if not arguments.mesh and not os.path.exists(model):
            continue
        try:
            read = getattr(importlib.import_module(_MODULE), _SURFACES)
        except ImportError as exc:
            if not arguments.mesh:
                return  # boxes do without
            raise UsageError(f"--mesh needs the extra train ({exc}): pip install 'curio-pose[train]'") from exc
        estimator.surfaces = read(estimator.spec, model, arguments.mesh, arguments.mesh_unit)
