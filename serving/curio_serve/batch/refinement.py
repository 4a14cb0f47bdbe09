"""``curio-detect --refine`` improves poses by render-and-compare; it needs the extra ``train``.

Serving has no renderer of its own. It imports the refiner from training, by name, only if a call asks for it.
"""

import importlib
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

_MODULE, _FUNCTION = "curio_train.commands.refine", "refiner"


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


def load_refiner(spec: ModelSpec, model: str, mesh: Path | None, unit: str | None) -> Refiner:
    """Render-and-compare for the object of a model.

    Args:
        spec: Of the model.
        model: Its path; the mesh may lie beside it.
        mesh: The object's; None: that of the run which the model lies in.
        unit: Of the mesh's coordinates; None: the file's own, or metres.

    Raises:
        UsageError: The extra is not installed, there is no mesh, or it is none of the model's object.
    """
    try:
        make = getattr(importlib.import_module(_MODULE), _FUNCTION)
        made: Refiner = make(spec, model, mesh, unit)
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
        UsageError: The call names a mesh without ``--refine``, several models, a cluster, a video or tracks; or as of
            :func:`load_refiner`.
    """
    if not arguments.refine:
        if arguments.mesh is not None or arguments.mesh_unit is not None:
            raise UsageError("--mesh and --mesh-unit are for --refine; add it, or leave them out")
        return None
    if arguments.ray is not None or arguments.video is not None or arguments.track:
        raise UsageError("--refine takes seconds a pose, in this process alone: leave out --ray, --video and --track")
    if len(estimators) != 1:
        raise UsageError(f"--refine needs the mesh of one model, found {len(estimators)} models; name one")
    refiner = load_refiner(estimators[0].spec, model, arguments.mesh, arguments.mesh_unit)
    estimators[0] = RefiningEstimator(estimators[0], refiner)
    return refiner
