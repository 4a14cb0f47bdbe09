"""LineMOD: one known object in front of clutter, six degrees of freedom and light (paper, section "LineMOD").

The scene code is the paper's R¹²: position 3, rotation 6, light 3. Images are rendered without end over cluttered
backgrounds; poses come from the range that the data set's authors publish (Hinterstoisser et al. 2012: the upper
hemisphere around an object that stands on a table, camera rolled by up to 45°; BOP's LM-O reaches further in depth).

Constants fixed before any training:

* depth 0.5 to 1.5 m; the object's centre anywhere in the frame;
* light from the camera's half space, of strength 0.2 to 2 over an ambient radiance of 0.4; the object's own colours
  0.3 to 1.25 times as bright, and tinted, in crops; 0.5 to 1.25 times, and a little tinted, in whole frames.
"""

import logging
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np

from curio_train.camera import Intrinsics
from curio_train.capture.plane import CameraPoseFile
from curio_train.capture.structure import recover
from curio_train.data.backgrounds import Backgrounds, ClutterBackgrounds, PhotographBackgrounds
from curio_train.data.bop import BopDataset
from curio_train.data.photographs import MAX_UNLABELLED, CameraPoses, Photographs, UnlabelledPhotographs, spread
from curio_train.errors import CameraError, CurioError, UsageError
from curio_train.worlds.base import ObjectKind, World
from curio_train.worlds.options import ALL_CLASSES, LinemodOptions
from curio_train.worlds.several_objects.world import SeveralObjectsWorld
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.world import Object, SingleObjectWorld, pose_layout, position_field, squeezed

SIDE_PX = 128
NEAR_M, FAR_M = 0.5, 1.5
SCAN_EXCESS_M = 1e-3
"""How much the data set's scanned meshes are too thick on every side (docs/experiments/real_photographs.md)."""

_log = logging.getLogger(__name__)


class LinemodPhotographs:
    """Frames of the data set's camera, opened without labels."""

    def __init__(self, folder: Path, camera: Intrinsics, views: Path | None = None) -> None:
        """Read nothing yet.

        Args:
            folder: Of the frames.
            camera: That took them.
            views: File with the camera's poses; they are recovered from the frames without it.
        """
        self._folder, self._camera, self._views = folder, camera, views
        self._unlabelled: UnlabelledPhotographs | None = None

    def paths(self) -> Sequence[Path]:
        """Files of the frames.

        Raises:
            DataError: The folder cannot be read.
        """
        return Photographs(self._folder).paths

    def unlabelled_paths(self) -> Sequence[Path]:
        """Files of the frames that a network learns from.

        Raises:
            DataError: The folder cannot be read.
        """
        return spread(self.paths(), MAX_UNLABELLED)

    def unlabelled(self) -> UnlabelledPhotographs:
        """The frames; the poses of their cameras are recovered once.

        Raises:
            DataError: The folder cannot be read.
            CameraError: The file of camera poses cannot be used.
        """
        paths = self.unlabelled_paths()
        if self._unlabelled is None or self._unlabelled.paths != paths:
            self._unlabelled = UnlabelledPhotographs(paths, self._camera_poses(paths))
        return self._unlabelled

    def _camera_poses(self, paths: Sequence[Path]) -> CameraPoses | None:
        if self._views is not None:
            return read_camera_poses(self._views, paths)
        try:
            structure = recover(paths, self._camera)
        except CurioError as exc:
            _log.warning("photographs do not correct each other, because no camera poses were recovered: %s", exc)
            return None
        matrices = np.full((len(paths), 4, 4), np.nan)
        matrices[[paths.index(path) for path in structure.photographs]] = structure.cam_from_world
        return CameraPoses(matrices)


def read_camera_poses(file: Path, paths: Sequence[Path], *, any_unit: bool = False) -> CameraPoses:
    """Camera poses of photographs from a file of ``--views-out``.

    Args:
        file: Its path.
        paths: The photographs.
        any_unit: Poses of no known unit will do where none is in metres.

    Raises:
        CameraError: The file cannot be read, has no such pose of these photographs, or a pose is not rigid.
    """
    poses = CameraPoseFile.read(file, "--views")
    in_metres = not any_unit or any(map(poses.in_metres, paths))
    is_known = poses.in_metres if in_metres else poses.is_known
    unknown = np.full((4, 4), np.nan)
    matrices = [poses.cam_from_world(path) if is_known(path) else unknown for path in paths]
    cameras = CameraPoses(np.stack(matrices), in_metres=in_metres)
    if not cameras.known.any():
        raise CameraError(
            f"--views {file}: has none of {paths[0].name} and {len(paths) - 1} more"
            + (' with "unit": "m"' if in_metres else "")
            + "; write it with curio-train capture --calibrate --views-out"
            + (", with --distance-m or --objects" if in_metres else "")
        )
    return cameras


def build(options: LinemodOptions) -> World:
    """The world of LineMOD classes, for a locator and templates; or of one, for two stages or the paper's network.

    Raises:
        UsageError: Unknown class or no data.
        DataError: The folder is not a BOP data set, or lacks the class.
        MeshError: The mesh is broken.
    """
    if options.data is None:
        raise UsageError(
            "linemod needs meshes and cameras, found neither --data nor --download: --data DIR names a folder in BOP's "
            "layout (lm or lmo), --download fetches LineMOD from BOP's repository"
        )
    dataset = BopDataset(options.data)
    names = dataset.classes if options.class_name == ALL_CLASSES else options.class_name.split(",")

    @cache
    def backgrounds(folder: Path) -> Backgrounds:
        if options.backgrounds:
            return PhotographBackgrounds(Photographs(options.backgrounds))
        others = [dataset.mesh(other) for other in dataset.classes if other not in names]
        return ClutterBackgrounds.cached(folder, others)

    members = [_object(dataset, name, slot, backgrounds) for slot, name in enumerate(names)]
    photographs = None
    if options.photos is not None:
        photographs = LinemodPhotographs(options.photos, dataset.camera, options.views)
    if options.two_stage:
        return TwoStageWorld("linemod", members[0], photographs)
    if not options.gaze:
        layout = pose_layout(position_field(members[0]), confidence=False)
        return SingleObjectWorld("linemod", members[0], squeezed(dataset.camera, SIDE_PX), layout)
    exact = [member.without_scan_excess() for member in members]
    return SeveralObjectsWorld("linemod", exact, photographs, names[0] if len(names) == 1 else None)


def _object(dataset: BopDataset, name: str, slot: int, backgrounds: Callable[[Path], Backgrounds]) -> Object:
    """One class of the data set."""
    mesh, info = dataset.mesh(name), dataset.model_info(name)
    kind = ObjectKind(
        name,
        (slot,),
        info.diameter_m,
        mesh.box_corners_m,
        mesh.sha256,
        info.symmetries,
        info.symmetry_axes,
        hull_m=mesh.hull_m,
        attribution=dataset.attribution,
    )
    return Object(kind, mesh, dataset.camera, NEAR_M, FAR_M, backgrounds, scan_excess_m=SCAN_EXCESS_M)
