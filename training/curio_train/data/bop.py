"""Data sets in the layout of the BOP challenge, as downloaded: LineMOD (lm) and Linemod-Occluded (lmo).

    ROOT/camera.json                 ROOT/models/obj_000001.ply … models_info.json      ROOT/models_eval/ (optional)
    ROOT/test/000001/rgb/000000.png  scene_camera.json  scene_gt.json  scene_gt_info.json      ROOT/train…/ likewise

The format is described at https://bop.felk.cvut.cz and in docs/bop_datasets_format.md of thodan/bop_toolkit. BOP counts
in millimetres; everything that leaves this module is in metres. Frames never open an annotation file:
``scene_gt.json`` is read by :meth:`BopDataset.annotations` alone.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from curio_serve.bop import LINEMOD_IDS
from curio_serve.imaging.rotation import are_several_axes, is_rotation
from PIL import Image

from curio_train.camera import Intrinsics, check_matrix, load_intrinsics
from curio_train.data.bop_json import Record, read_records
from curio_train.errors import DataError, UsageError, nearest
from curio_train.geometry import Pose
from curio_train.meshes.meshes import METRES, Mesh, load_mesh

LINEMOD_CLASSES = tuple(name for name in LINEMOD_IDS if name not in ("bowl", "cup"))
"""The 13 that papers report: bowl and cup have no usable meshes in the original."""

_OCCLUDED_IDS = {1, 5, 6, 8, 9, 10, 11, 12}
"""The objects of Linemod-Occluded."""

_LINEMOD = "LineMOD (Hinterstoisser et al. 2012)"
_BOP = "as published by the BOP benchmark, https://bop.felk.cvut.cz"

_MM = METRES["mm"]
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
_HOW_TO_GET = (
    "download it with: hf download bop-benchmark/{name} --repo-type dataset --local-dir DIR, and unpack the zips"
)


@dataclass(frozen=True, eq=False)
class Frame:
    """One image and its camera; no label."""

    scene_id: int
    """Number of the scene folder."""
    image_id: int
    """Number in the file's name."""
    path: Path
    """The image file."""
    matrix: np.ndarray
    """K [3, 3], pixels, pixel centres at integers."""
    width: int
    """Width of the file, pixels."""
    height: int
    """Height of the file, pixels."""


@dataclass(frozen=True, eq=False)
class Annotation:
    """One object in one image: labels, for scoring."""

    scene_id: int
    """Number of the scene folder."""
    image_id: int
    """Number of the image."""
    object_id: int
    """BOP's number of the object."""
    pose: Pose
    """Cam_from_obj, metres."""
    visible_fraction: float | None
    """Visible fraction of the object's silhouette, in [0, 1]; None where ``scene_gt_info.json`` is missing."""


@dataclass(frozen=True)
class Target:
    """One target of a BOP submission: a number of instances of an object in an image."""

    scene_id: int
    image_id: int
    object_id: int
    num_instances: int


@dataclass(frozen=True, eq=False)
class ModelInfo:
    """The entry of an object in ``models_info.json``."""

    diameter_m: float
    """Largest distance of two model points."""
    symmetries: tuple[np.ndarray, ...] = ()
    """Discrete ones, each [4, 4] in metres, the identity left out."""
    symmetry_axes: tuple[tuple[np.ndarray, np.ndarray], ...] = ()
    """Continuous ones, each (axis [3], point on it in metres [3])."""

    @property
    def is_symmetric(self) -> bool:
        """Whether more than one pose looks the same; such objects are scored by ADD-S."""
        return bool(self.symmetries or self.symmetry_axes)

    @property
    def turns_any_way(self) -> bool:
        """Whether it looks the same after every turn about its centre, as a ball does: it has two axes or more."""
        return are_several_axes([axis for axis, _ in self.symmetry_axes])


class BopDataset:
    """A data folder; files are read when asked for.

    Args:
        root: The folder with ``models`` in it.

    Raises:
        DataError: The folder is missing or not in BOP's layout.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        missing = [name for name in ("camera.json", "models") if not (root / name).exists()]
        if not missing:
            return
        hint = _HOW_TO_GET.format(name="lmo" if root.name == "lmo" else "lm")
        if not root.is_dir():
            raise DataError(f"{root}: there is no such folder; expected a BOP data set. To get LineMOD, {hint}")
        inside = [str(path.parent) for path in sorted(root.glob("*/models"))]
        remedy = f"did you mean {' or '.join(inside)}?" if inside else f"to get LineMOD, {hint}"
        raise DataError(
            f"{root}: not a BOP data set, looked for {' and '.join(missing)} in it and found none; {remedy}"
        )

    @staticmethod
    def object_id(name: str) -> int:
        """BOP's number of a LineMOD class.

        Raises:
            UsageError: There is no such class.
        """
        if name not in LINEMOD_IDS:
            raise UsageError(
                f"--class: found {name!r}{nearest(name, LINEMOD_IDS)}, expected one of {' '.join(LINEMOD_IDS)}"
            )
        return LINEMOD_IDS[name]

    @cached_property
    def camera(self) -> Intrinsics:
        """``camera.json``: the camera of most of the data set's images."""
        return load_intrinsics(self.root / "camera.json")

    @property
    def classes(self) -> tuple[str, ...]:
        """The LineMOD classes whose meshes are in this folder."""
        return tuple(name for name, number in LINEMOD_IDS.items() if self._mesh_path("models", number).exists())

    @property
    def attribution(self) -> str:
        """Source and licence of the meshes here: Linemod-Occluded's where its eight objects are all there is."""
        if {LINEMOD_IDS[name] for name in self.classes} == _OCCLUDED_IDS:
            return f"Linemod-Occluded (Brachmann et al. 2014) after {_LINEMOD}, {_BOP}, CC BY-SA 4.0"
        return f"{_LINEMOD}, {_BOP}, CC BY 4.0"

    def mesh(self, name: str) -> Mesh:
        """The full mesh of a class, in metres.

        Raises:
            UsageError: There is no such class.
            DataError: This folder does not have it.
            MeshError: The file is broken.
        """
        path = self._mesh_path("models", self.object_id(name))
        if not path.exists():
            found = " ".join(self.classes) or "none"
            raise DataError(f"{path}: there is no mesh of {name} here; found meshes of: {found}")
        return load_mesh(path, "mm")

    def evaluation_mesh(self, name: str) -> Mesh:
        """The mesh BOP scores with, from ``models_eval`` where that exists, else the full one."""
        path = self._mesh_path("models_eval", self.object_id(name))
        return load_mesh(path, "mm") if path.exists() else self.mesh(name)

    def _mesh_path(self, folder: str, number: int) -> Path:
        return self.root / folder / f"obj_{number:06d}.ply"

    def model_info(self, name: str) -> ModelInfo:
        """Diameter and symmetries of a class.

        Raises:
            UsageError: There is no such class.
            DataError: ``models_info.json`` is missing, broken or without that class, or says what cannot be.
        """
        record = read_records(self.root / "models" / "models_info.json").entry(str(self.object_id(name)))
        discrete = [
            np.array(record.numbers(f"symmetries_discrete/{i}", 16))
            for i in range(record.length("symmetries_discrete"))
        ]
        axes = [record.entry(f"symmetries_continuous/{i}") for i in range(record.length("symmetries_continuous"))]
        diameter_mm = record.numbers("diameter", 1)[0]
        if not diameter_mm > 0:
            raise DataError(f"{record.where}, diameter: found {diameter_mm}, expected more than 0 millimetres")
        for axis in axes:
            if not any(axis.numbers("axis", 3)):
                raise DataError(f"{axis.where}, axis: found 0 in all directions, expected an axis")
        for i, matrix in enumerate(discrete):
            _check_rotation(matrix.reshape(4, 4)[:3, :3], f"{record.where}, symmetries_discrete/{i}")
        return ModelInfo(
            diameter_m=diameter_mm * _MM,
            symmetries=tuple(_in_metres(matrix.reshape(4, 4)) for matrix in discrete),
            symmetry_axes=tuple((np.array(a.numbers("axis", 3)), np.array(a.numbers("offset", 3)) * _MM) for a in axes),
        )

    def frames(self, split: str = "test", scene_id: int | None = None) -> Iterator[Frame]:
        """Images with their cameras in the order of scene and image number. Opens no label file.

        Args:
            split: Folder in the root: ``test``, ``train``, ``train_pbr``, …
            scene_id: Only that scene. In lm, scene n shows object n.

        Raises:
            DataError: A folder, an image or an entry of ``scene_camera.json`` is missing or broken.
            CameraError: A K does not fit its image.
        """
        for scene in self._scenes(split, scene_id):
            cameras = read_records(scene / "scene_camera.json")
            for path in _images(scene):
                width, height = _image_size(path)
                where = f"{cameras.where}, {int(path.stem)}/cam_K"
                rows = np.reshape(cameras.numbers(f"{int(path.stem)}/cam_K", 9), (3, 3))
                matrix = check_matrix(rows, width, height, where)
                yield Frame(int(scene.name), int(path.stem), path, matrix, width, height)

    def annotations(self, split: str = "test", name: str | None = None) -> Iterator[Annotation]:
        """The true poses of a class, or of everything, from ``scene_gt.json``.

        Raises:
            UsageError: There is no such class.
            DataError: A file is missing or broken; says which entry.
        """
        wanted = None if name is None else self.object_id(name)
        for scene in self._scenes(split, None):
            truth = read_records(scene / "scene_gt.json")
            info_path = scene / "scene_gt_info.json"
            info = read_records(info_path) if info_path.exists() else None
            for key in sorted(truth.keys(), key=int):
                for i in range(truth.length(key)):
                    record = truth.entry(f"{key}/{i}")
                    object_id = record.integer("obj_id")
                    if wanted in (None, object_id):
                        visible = None if info is None else info.numbers(f"{key}/{i}/visib_fract", 1)[0]
                        yield Annotation(int(scene.name), int(key), object_id, _pose(record), visible)

    def targets(self) -> list[Target]:
        """The targets of ``test_targets_bop19.json``.

        Raises:
            DataError: It is missing or broken.
        """
        records = read_records(self.root / "test_targets_bop19.json")
        keys = ("scene_id", "im_id", "obj_id", "inst_count")
        entries = [records.entry(str(i)) for i in range(records.length())]
        return [Target(*(entry.integer(key) for key in keys)) for entry in entries]

    def _scenes(self, split: str, scene_id: int | None) -> list[Path]:
        folder = self.root / split
        scenes = sorted(path for path in folder.glob("*") if path.is_dir() and path.name.isdecimal())
        if not scenes:
            splits = sorted({str(path.parent.parent.name) for path in self.root.glob("*/*/scene_camera.json")})
            raise DataError(
                f"{folder}: found no scene folders such as 000001; splits here: {' '.join(splits) or 'none'}"
            )
        if scene_id is None:
            return scenes
        chosen = [path for path in scenes if int(path.name) == scene_id]
        if not chosen:
            raise DataError(f"{folder}: found no scene {scene_id:06d}, only {' '.join(path.name for path in scenes)}")
        return chosen


def _images(scene: Path) -> list[Path]:
    """The colour images of a scene, or the grey ones where it has no others."""
    for folder in ("rgb", "gray"):
        found = [path for path in (scene / folder).glob("*") if path.suffix.lower() in _IMAGE_SUFFIXES]
        named = sorted((path for path in found if path.stem.isdecimal()), key=lambda path: int(path.stem))
        if named:
            return named
    raise DataError(f"{scene}: found no images such as rgb/000000.png or gray/000000.png")


def _image_size(path: Path) -> tuple[int, int]:
    """Width and height from the file's head; the pixels are not decoded."""
    try:
        with Image.open(path) as image:
            return image.size
    except (OSError, ValueError, Image.DecompressionBombError) as exc:
        raise DataError(f"{path}: not a readable image ({exc})") from exc


def _in_metres(matrix: np.ndarray) -> np.ndarray:
    return np.concatenate([matrix[:, :3], matrix[:, 3:] * [[_MM], [_MM], [_MM], [1]]], axis=1)


def _pose(record: Record) -> Pose:
    rotation = np.reshape(record.numbers("cam_R_m2c", 9), (3, 3))
    _check_rotation(rotation, f"{record.where}, cam_R_m2c")
    return Pose(rotation, np.array(record.numbers("cam_t_m2c", 3)) * _MM)


def _check_rotation(matrix: np.ndarray, where: str) -> None:
    if not is_rotation(matrix, 1e-2):
        raise DataError(f"{where}: found {matrix.tolist()}, which is not a rotation")
