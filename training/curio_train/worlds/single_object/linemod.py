"""LineMOD: one known object in front of clutter, six degrees of freedom and light (paper, section "LineMOD").

The scene code is the paper's R¹²: position 3, rotation 6, light 3. Images are rendered without end over cluttered
backgrounds; poses come from the range that the data set's authors publish (Hinterstoisser et al. 2012: the upper
hemisphere around an object that stands on a table, camera rolled by up to 45°; BOP's LM-O reaches further in depth).

Constants fixed before any training:

* depth 0.5 to 1.5 m; the object's centre anywhere in the frame;
* light from the camera's half space, of strength 0.2 to 2 over an ambient radiance of 0.4; the object's own colours
  0.3 to 1.25 times as bright, and tinted, in crops; 0.5 to 1.25 times, and a little tinted, in frames read by a gaze.
"""

import logging
from pathlib import Path

import numpy as np

from curio_train.capture.plane import CameraPoseFile
from curio_train.capture.structure import recover
from curio_train.data.backgrounds import Backgrounds, ClutterBackgrounds, PhotographBackgrounds
from curio_train.data.bop import BopDataset
from curio_train.data.photographs import MAX_UNLABELLED, CameraPoses, Photographs, UnlabelledPhotographs, spread
from curio_train.errors import CameraError, CurioError, UsageError
from curio_train.worlds.base import ObjectKind
from curio_train.worlds.options import LinemodOptions
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.world import Object, SingleObjectWorld, pose_layout, position_field, squeezed

SIDE_PX = 128
NEAR_M, FAR_M = 0.5, 1.5

_log = logging.getLogger(__name__)


class Linemod(SingleObjectWorld):
    """One LineMOD object in the whole frame, squeezed into 128x128 pixels and read at one look as in the paper."""

    name = "linemod"

    def __init__(self, thing: Object) -> None:
        super().__init__(thing, squeezed(thing.camera, SIDE_PX), pose_layout(position_field(thing), confidence=False))


class TwoStageLinemod(TwoStageWorld):
    """One LineMOD object read at two looks, in frames of which some may be there without labels."""

    def __init__(self, thing: Object, photographs: Path | None, views: Path | None = None) -> None:
        """Nothing of the photographs is read before they are asked for.

        Args:
            thing: The object.
            photographs: Their folder.
            views: File with where their camera stood.
        """
        super().__init__(Linemod.name, thing)
        self._folder, self._views = photographs, views
        self._placed: UnlabelledPhotographs | None = None

    def unlabelled(self) -> UnlabelledPhotographs:
        """The photographs of the given folder; the poses of their cameras are found once."""
        if self._folder is None:
            return UnlabelledPhotographs(())
        paths = spread(Photographs(self._folder).paths, MAX_UNLABELLED)
        if self._placed is None or self._placed.paths != paths:
            self._placed = UnlabelledPhotographs(paths, self.cameras(paths))
        return self._placed

    def cameras(self, paths: list[Path]) -> CameraPoses | None:
        """Where the camera stood; None if it is known of no photograph.

        Raises:
            CameraError: There is a file that should say it, and it does not do.
        """
        if self._views is not None:
            return read_camera_poses(self._views, paths)
        try:
            structure = recover(paths, self.object.camera)
        except CurioError as exc:
            _log.warning("photographs teach one by one, because their cameras cannot be placed: %s", exc)
            return None
        matrices = np.full((len(paths), 4, 4), np.nan)
        matrices[[paths.index(path) for path in structure.photographs]] = structure.cam_from_world
        return CameraPoses(matrices)


def read_camera_poses(file: Path, paths: list[Path]) -> CameraPoses:
    """Where photographs were taken, in metres, by a file of ``--views-out``.

    Raises:
        CameraError: It cannot be read, says nothing of these photographs in metres, or a place is none.
    """
    places = CameraPoseFile.read(file, "--views")
    unknown = np.full((4, 4), np.nan)
    matrices = [places.anywhere(path) if places.in_metres(path) else unknown for path in paths]
    cameras = CameraPoses(np.stack(matrices), in_metres=True)
    if not cameras.known.any():
        raise CameraError(
            f'--views {file}: has none of {paths[0].name} and {len(paths) - 1} more with "unit": "m"; write it with '
            "curio-train capture --calibrate --views-out, with --distance-m or --objects"
        )
    return cameras


def build(options: LinemodOptions) -> SingleObjectWorld:
    """The world of one LineMOD class, to be read at two looks or at one.

    Raises:
        UsageError: Unknown class, no data, or photographs without a gaze.
        DataError: The folder is not a BOP data set, or lacks the class.
        MeshError: The mesh is broken.
    """
    if options.data is None:
        raise UsageError(
            "linemod needs meshes and cameras, found neither --data nor --download: --data DIR names a folder in BOP's "
            "layout (lm or lmo), --download fetches LineMOD from BOP's repository"
        )
    dataset = BopDataset(options.data)
    name = options.class_name
    mesh, info = dataset.mesh(name), dataset.model_info(name)
    kind = ObjectKind(
        name,
        (0,),
        info.diameter_m,
        mesh.box_corners_m,
        mesh.sha256,
        info.symmetries,
        info.symmetry_axes,
        dataset.attribution,
    )

    def backgrounds(cache: Path) -> Backgrounds:
        if options.backgrounds:
            return PhotographBackgrounds(Photographs(options.backgrounds))
        others = [dataset.mesh(other) for other in dataset.classes if other != name]
        return ClutterBackgrounds.cached(cache, others)

    thing = Object(kind, mesh, dataset.camera, NEAR_M, FAR_M, backgrounds)
    if options.views is not None and options.photos is None:
        raise UsageError(f"--views {options.views}: they say where photographs were taken; give these, too: --photos")
    if not options.gaze:
        if options.photos is not None:
            raise UsageError(f"--photos {options.photos}: they teach the second look of a gaze; leave out --no-gaze")
        return Linemod(thing)
    return TwoStageLinemod(thing, options.photos, options.views)
