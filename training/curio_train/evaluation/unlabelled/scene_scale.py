"""How large a scene is, by objects in it that networks can read: structure from motion leaves that open.

One object's depth is read with an error of some per cent, all to one side, because its mesh, its surface and the
camera are never quite what renderings say. Several objects of one scene share its scale and err each in its own way, so
their mean errs less than most of them (decision 68). No label is opened.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from curio_train.camera import Intrinsics
from curio_train.capture.ground import scaled
from curio_train.capture.structure import Structure
from curio_train.data.photographs import CameraPoses, read_frames, spread
from curio_train.errors import DataError, UsageError
from curio_train.evaluation.subject import Subject, load_subject
from curio_train.evaluation.unlabelled.candidates import candidates
from curio_train.refinement.multi_view import estimate_scale
from curio_train.refinement.predictions import refiners
from curio_train.refinement.pseudo_labels import refined_poses
from curio_train.scene_code import of_slot
from curio_train.worlds.several_objects.world import SeveralObjectsWorld
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.world import Object

MOST_PHOTOGRAPHS = 100
"""Most photographs that are used: further ones tell little, because an object's error is the same in all."""

_SAME_CAMERA = 0.01  # of the focal length, and of it for the centre


def scale_by_objects(
    models: Path, data: Path | None, camera: Intrinsics, report: Callable[[str], None]
) -> Callable[[Structure], tuple[Structure, str]]:
    """Get ready to scale structures to metres by the poses that trained networks predict in the photographs.

    Everything is loaded and checked at once, because a structure takes minutes.

    Args:
        models: A run or a model of LineMOD objects, or a folder with one of each object.
        data: Data folder of exported models.
        camera: Of the photographs.
        report: Called with a line after each object, which takes about a minute.

    Returns:
        What brings a structure of any scale to metres, and says in a line how well the objects agree. It raises
        DataError where a photograph cannot be read or no object tells a scale.

    Raises:
        UsageError: No model there, two of one object, or one that cannot be used for this or is of another camera.
        CheckpointError: A run is damaged.
        ExportError: A model is broken.
        DataError: The data cannot be read.
    """
    named = {one.path: load_subject(one.path, data) for one in candidates(models, "--objects", of_any_method=False)}
    for path, subject in named.items():
        _check_subject(path, subject, camera)

    def in_metres(structure: Structure) -> tuple[Structure, str]:
        scales = {}
        for subject in named.values():
            for name, scale in _scales_by(subject, structure):
                report(f"{name}: {'seen too seldom to tell' if scale is None else f'{scale:.4g} m a unit'}")
                if scale is not None:
                    scales[name] = scale
        if not scales:
            raise DataError(
                f"--objects {models}: none of the objects was read alike in enough photographs to tell how large the "
                "scene is; give networks of objects that it shows, or --distance-m"
            )
        scale, line = mean_scale(scales)
        return scaled(structure, scale), line

    return in_metres


def mean_scale(scales: Mapping[str, float]) -> tuple[float, str]:
    """The geometric mean of what objects tell, and how far they are from it."""
    logs = np.log(list(scales.values()))
    each = ", ".join(f"{name} {100 * off:+.1f} %" for name, off in zip(scales, logs - logs.mean(), strict=True))
    error = "" if len(logs) < 2 else f"; the mean is good to {100 * logs.std(ddof=1) / len(logs) ** 0.5:.1f} %"
    return float(np.exp(logs.mean())), f"scale by each object beside their mean: {each}{error}"


def _check_subject(path: Path, subject: Subject, camera: Intrinsics) -> None:
    """Refuse a network that finds no objects in whole frames, or in those of another camera."""
    if not isinstance(subject.world, TwoStageWorld | SeveralObjectsWorld):
        raise UsageError(f"{path}: the paper's network (--one-stage), expected one that finds objects in whole frames")
    own = _objects(subject)[0].camera
    if np.abs(own.matrix - camera.matrix).max() > _SAME_CAMERA * own.matrix[0, 0]:
        raise UsageError(
            f"{path}: reads frames of a camera with a focal length of {own.matrix[0, 0]:.1f} pixels, but --camera "
            f"has {camera.matrix[0, 0]:.1f}, or another centre; give the data set's camera.json"
        )


def _objects(subject: Subject) -> Sequence[Object]:
    world = subject.world
    assert isinstance(world, TwoStageWorld | SeveralObjectsWorld)  # as was checked
    return world.members if isinstance(world, SeveralObjectsWorld) else (world.object,)


def _scales_by(subject: Subject, structure: Structure) -> Iterator[tuple[str, float | None]]:
    """Metres a unit by each object that a network reads; None where it is read alike too seldom."""
    world, objects = subject.world, _objects(subject)
    size = world.camera.width, world.camera.height
    chosen = spread(structure.photographs, MOST_PHOTOGRAPHS)
    matrices = structure.cam_from_world[[structure.photographs.index(photograph) for photograph in chosen]]
    frames = torch.from_numpy(read_frames(chosen, objects[0].camera, *size))
    code = subject.predict(frames)
    for slot, refiner in enumerate(refiners(world, subject.config.method)):
        refined, accepted = refined_poses(refiner, frames, of_slot(code, slot))
        yield objects[slot].kind.name, estimate_scale(CameraPoses(matrices), refined, accepted, refiner.diameter_m)
