"""How large a scene is, by objects in it that networks can read: structure from motion leaves that open.

One object's depth is read with an error of some per cent, all to one side, because its mesh, its surface and the
camera are never quite what renderings say. Several objects of one scene share its scale and err each in its own way, so
their mean errs less than most of them (decision 68). No label is opened.
"""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import torch

from curio_train.capture.ground import scaled
from curio_train.capture.structure import Structure
from curio_train.data.photographs import CameraPoses, read_frames, spread
from curio_train.errors import DataError, UsageError
from curio_train.evaluation.subject import load_subject
from curio_train.evaluation.unlabelled.candidates import candidates
from curio_train.refinement.multi_view import estimate_scale
from curio_train.refinement.predictions import refiners
from curio_train.refinement.pseudo_labels import refined_poses
from curio_train.scene_code import of_slot
from curio_train.worlds.several_objects.world import SeveralObjectsWorld
from curio_train.worlds.single_object.two_stage import TwoStageWorld

MOST_PHOTOGRAPHS = 100
"""Most photographs that are used: further ones tell little, because an object's error is the same in all."""

_SAME_CAMERA = 0.01  # of the focal length, and of it for the centre


def check_objects(models: Path, data: Path | None) -> None:
    """Find out before minutes are spent on a structure whether :func:`scale_by_objects` can use models and data.

    Args:
        models: A run or a model of LineMOD objects, or a folder with one of each object.
        data: Data folder of exported models.

    Raises:
        UsageError: No model there, or two of one object.
        ExportError: A model is broken.
        DataError: The data cannot be read.
    """
    first, *_ = candidates(models, "--objects", of_any_method=False)
    load_subject(first.path, data)


def scale_by_objects(
    structure: Structure, models: Path, data: Path | None, report: Callable[[str], None]
) -> tuple[Structure, str]:
    """Scale a structure to metres by the poses that trained networks predict in the photographs.

    Args:
        structure: Of any scale.
        models: A run or a model of LineMOD objects, or a folder with one of each object.
        data: Data folder of exported models.
        report: Called with a line after each object, which takes about a minute.

    Returns:
        The same in metres, and a line about how well the objects agree.

    Raises:
        UsageError: No model there, two of one object, or one that cannot be used for this.
        ExportError: A model is broken.
        DataError: A photograph or the data cannot be read, or no object tells a scale.
    """
    scales = {}
    for candidate in candidates(models, "--objects", of_any_method=False):
        for name, scale in _scales_by(candidate.path, data, structure):
            report(f"{name}: {'seen too seldom to tell' if scale is None else f'{scale:.4g} m a unit'}")
            if scale is not None:
                scales[name] = scale
    if not scales:
        raise DataError(
            f"--objects {models}: none of the objects was read alike in enough photographs to tell how large the scene "
            "is; give networks of objects that it shows, or --distance-m"
        )
    scale, line = mean_scale(scales)
    return scaled(structure, scale), line


def mean_scale(scales: Mapping[str, float]) -> tuple[float, str]:
    """The geometric mean of what objects tell, and how far they are from it."""
    logs = np.log(list(scales.values()))
    each = ", ".join(f"{name} {100 * off:+.1f} %" for name, off in zip(scales, logs - logs.mean(), strict=True))
    error = "" if len(logs) < 2 else f"; the mean is good to {100 * logs.std(ddof=1) / len(logs) ** 0.5:.1f} %"
    return float(np.exp(logs.mean())), f"scale by each object beside their mean: {each}{error}"


def _scales_by(path: Path, data: Path | None, structure: Structure) -> Iterator[tuple[str, float | None]]:
    """Metres a unit by each object that a network reads; None where it is read alike too seldom."""
    subject = load_subject(path, data)
    world = subject.world
    if not isinstance(world, TwoStageWorld | SeveralObjectsWorld):
        raise UsageError(f"{path}: the paper's network (--one-stage), expected one that finds objects in whole frames")
    objects = world.members if isinstance(world, SeveralObjectsWorld) else (world.object,)
    camera = objects[0].camera
    if np.abs(camera.matrix - structure.camera.matrix).max() > _SAME_CAMERA * camera.matrix[0, 0]:
        raise UsageError(
            f"{path}: reads frames of a camera with a focal length of {camera.matrix[0, 0]:.1f} pixels, but --camera "
            f"has {structure.camera.matrix[0, 0]:.1f}, or another centre; give the data set's camera.json"
        )
    chosen = spread(structure.photographs, MOST_PHOTOGRAPHS)
    matrices = structure.cam_from_world[[structure.photographs.index(photograph) for photograph in chosen]]
    frames = torch.from_numpy(read_frames(chosen, camera, world.camera.width, world.camera.height))
    code = subject.predict(frames)
    for slot, refiner in enumerate(refiners(world, subject.config.method)):
        refined, accepted = refined_poses(refiner, frames, of_slot(code, slot))
        yield objects[slot].kind.name, estimate_scale(CameraPoses(matrices), refined, accepted, refiner.diameter_m)
