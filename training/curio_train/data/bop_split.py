"""Which real frames score an object: published image lists, BOP's targets, or LineMOD's 15/85 by image number.

Papers on LineMOD train on about 15 % of an object's frames and test on the others (Brachmann et al. 2016, Rad and
Lepetit 2017). Their lists are published beside the data and not with it, so a folder may have them or not. Every result
carries the name of the split it was scored on.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from curio_train.data.bop import Annotation, BopDataset
from curio_train.errors import DataError

SPLIT = "test"
"""The folder of real frames; LineMOD's training frames lie in it, too."""

BY_NUMBER = "15/85 by image number"
BOP_TARGETS = "bop19 targets"
ALL_FRAMES = "all labelled frames"

_LISTS = ("image_set/{name}_test.txt", "{name}/test.txt", "test/{number:06d}/test.txt")
_TRAINING_NUMBERS = (3, 10, 17)  # of each twenty: 15 %, evenly spread


@dataclass(frozen=True, eq=False)
class ScoredFrames:
    """The frames to score an object on."""

    split_name: str
    """How they were chosen."""
    targets: Sequence[Annotation]
    """Targets of the object, at most one a frame."""


def scored_frames(dataset: BopDataset, name: str) -> ScoredFrames:
    """The frames a class is scored on; the labels of all its frames are read for it.

    A published list comes first. Where every frame of the object lies in the scene of its own number the data set is
    LineMOD, and all frames are taken but those whose number modulo 20 is 3, 10 or 17. Else BOP's targets are taken,
    and without those all labelled frames.

    Raises:
        UsageError: There is no such class.
        DataError: A file is missing or broken, or no frame is left.
    """
    number = dataset.object_id(name)
    labelled = list(dataset.annotations(SPLIT, name))
    if (listed := _list_of(dataset.root, name, number)) is not None:
        numbers = _read_list(dataset.root / listed)
        split_name = listed
        chosen = [a for a in labelled if a.scene_id == number and a.image_id in numbers]
    elif labelled and {a.scene_id for a in labelled} == {number}:
        split_name = BY_NUMBER
        chosen = [a for a in labelled if a.image_id % 20 not in _TRAINING_NUMBERS]
    elif (dataset.root / "test_targets_bop19.json").exists():
        split_name = BOP_TARGETS
        wanted = {(t.scene_id, t.image_id) for t in dataset.targets() if t.object_id == number}
        chosen = [a for a in labelled if (a.scene_id, a.image_id) in wanted]
    else:
        split_name, chosen = ALL_FRAMES, labelled
    if not chosen:
        raise DataError(
            f"{dataset.root / SPLIT}: found no labelled frame of {name} among {split_name}, expected at least one"
        )
    return ScoredFrames(split_name, list({(a.scene_id, a.image_id): a for a in chosen}.values()))


def _list_of(root: Path, name: str, number: int) -> str | None:
    """Path of the published list of test images in the folder, if there is one."""
    paths = (pattern.format(name=name, number=number) for pattern in _LISTS)
    return next((path for path in paths if (root / path).is_file()), None)


def _read_list(path: Path) -> set[int]:
    """Image numbers of a list: one image a line, as a number or as the path of a file named after its number."""
    try:
        lines = path.read_text(encoding="utf-8").split()
    except (OSError, ValueError) as exc:
        raise DataError(f"{path}: not a readable list of images ({exc}); restore it, or remove it") from exc
    stems = [PurePosixPath(line).stem for line in lines]
    wrong = [line for line, stem in zip(lines, stems, strict=True) if not stem.isdecimal()]
    if wrong or not lines:
        raise DataError(f"{path}: found {wrong[0] if wrong else 'nothing'}, expected a number of an image a line")
    return {int(stem) for stem in stems}
