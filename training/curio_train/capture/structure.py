"""Where a camera stood, and what camera it was, from its photographs alone: structure from motion by pycolmap."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from curio_train.camera import Intrinsics, check_matrix
from curio_train.data.photographs import check_sizes
from curio_train.errors import CameraError, DataError

_FEWEST_PHOTOGRAPHS = 3
_FEWEST_PLACED = 0.8  # fraction of the photographs
_FEWEST_POINTS = 100
_LARGEST_ERROR_PX = 2.0
_NEIGHBOURS = 10
_MOST_FEATURES = 1200  # of a photograph: more cost minutes in matching and move cameras by nothing that counts
_COEFFICIENTS = 8  # of a lens
_LARGEST_COEFFICIENT = 1e6  # of a known lens: those of rational models cancel each other, but pycolmap expects 1
_ALL_PAIRS = 30  # so many photographs are compared pair by pair, longer sequences with neighbours alone


@dataclass(frozen=True, eq=False)
class Structure:
    """Cameras and points in a frame of arbitrary place and scale."""

    photographs: tuple[Path, ...]
    """Those that were placed, in the order given."""
    cam_from_world: np.ndarray
    """[n, 4, 4], rigid."""
    camera: Intrinsics
    """Camera of all photographs."""
    points: np.ndarray
    """[m, 3], world frame."""
    error_px: float
    """Mean distance of points from where they are seen."""

    @property
    def centres(self) -> np.ndarray:
        """Positions of the cameras, [n, 3], world frame."""
        rotations, shifts = self.cam_from_world[:, :3, :3], self.cam_from_world[:, :3, 3]
        return -np.einsum("nji,nj->ni", rotations, shifts)


def every_nth(photographs: Sequence[Path], step: int) -> list[Path]:
    """Every so many-th frame of a moving camera's sequence (the paper takes n = 10), from the first on.

    Raises:
        DataError: Too few are left.
    """
    chosen = list(photographs[::step])
    if len(chosen) < _FEWEST_PHOTOGRAPHS:
        found = f"found {len(photographs)} photographs, of which --every {step} leaves {len(chosen)}"
        raise DataError(f"{found}; expected at least {_FEWEST_PHOTOGRAPHS}")
    return chosen


def recover(photographs: Sequence[Path], camera: Intrinsics | None = None) -> Structure:
    """Place the cameras of photographs of one still scene.

    Args:
        photographs: Taken with one camera at one zoom, all in one folder.
        camera: Its K, where known; found from the photographs where not.

    Raises:
        DataError: Too few photographs, in several folders, or not of the known camera's size.
        CameraError: It cannot be done: no texture, no overlap, or a result that does not explain the photographs.
    """
    folders = {path.parent for path in photographs}
    if len(photographs) < _FEWEST_PHOTOGRAPHS or len(folders) != 1:
        raise DataError(
            f"found {len(photographs)} photographs in {len(folders)} folder(s), expected at least "
            f"{_FEWEST_PHOTOGRAPHS} in one"
        )
    if camera is not None:
        check_sizes(photographs, camera)
    with tempfile.TemporaryDirectory() as scratch:
        found = _map(photographs, camera, Path(scratch))
    return _checked(photographs, found, camera)


def _pycolmap() -> Any:
    try:
        import pycolmap
    except ImportError as exc:
        raise CameraError("structure from motion needs pycolmap: pip install 'curio-pose[capture]'") from exc
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    return pycolmap


def _names(photographs: Sequence[Path]) -> dict[Path, str]:
    """What COLMAP calls the photographs: it takes the order of their names, as text, for that of the sequence."""
    return {path: f"{number:06d}{path.suffix}" for number, path in enumerate(photographs)}


def _map(photographs: Sequence[Path], camera: Intrinsics | None, scratch: Path) -> Any:
    """The largest reconstruction."""
    pycolmap = _pycolmap()
    folder, names = scratch / "photographs", list(_names(photographs).values())
    folder.mkdir()
    for path, name in _names(photographs).items():
        (folder / name).symlink_to(path.absolute())
    pycolmap.set_random_seed(0)
    database = scratch / "database.db"
    reader, extraction = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = _MOST_FEATURES
    extraction.sift.first_octave = 0  # no magnified image: what is smaller than a pixel helps nobody
    options = pycolmap.IncrementalPipelineOptions(random_seed=0, multiple_models=False)
    if camera is not None:
        (fx, _, cx), (_, fy, cy), _ = camera.matrix
        reader.camera_model = "FULL_OPENCV"
        # Its pixel centres lie at half-integers.
        values = (fx, fy, cx + 0.5, cy + 0.5, *(*camera.distortion, *(0.0,) * _COEFFICIENTS)[:_COEFFICIENTS])
        reader.camera_params = ",".join(f"{value:.10g}" for value in values)
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.max_extra_param = _LARGEST_COEFFICIENT
    try:
        pycolmap.extract_features(database, folder, names, pycolmap.CameraMode.SINGLE, reader, extraction)
        if len(names) <= _ALL_PAIRS:
            pycolmap.match_exhaustive(database)
        else:
            pairing = pycolmap.SequentialPairingOptions(overlap=_NEIGHBOURS, quadratic_overlap=True)
            pycolmap.match_sequential(database, pairing_options=pairing)
        models = pycolmap.incremental_mapping(database, folder, scratch, options)
    except (ValueError, RuntimeError) as exc:
        raise CameraError(f"{photographs[0].parent}: pycolmap failed ({exc})") from exc
    if not models:
        raise CameraError(
            f"{photographs[0].parent}: no two of the {len(names)} photographs could be matched. The scene needs "
            "texture (lay printed paper or a cloth with a pattern around the object), and neighbouring views more "
            "overlap (at most 20 degrees apart)"
        )
    return max(models.values(), key=lambda model: model.num_reg_images())


def _checked(photographs: Sequence[Path], found: Any, known: Intrinsics | None) -> Structure:
    """The reconstruction in our conventions, or why it is not to be trusted."""
    poses = {image.name: image.cam_from_world().matrix() for image in found.images.values() if image.has_pose}
    names = _names(photographs)
    placed = tuple(path for path in photographs if names[path] in poses)
    missing = [path.name for path in photographs if names[path] not in poses]
    points = np.array([point.xyz for point in found.points3D.values()]).reshape(-1, 3)
    if len(placed) < _FEWEST_PLACED * len(photographs) or len(points) < _FEWEST_POINTS:
        raise CameraError(
            f"{photographs[0].parent}: placed {len(placed)} of {len(photographs)} photographs by {len(points)} points, "
            f"expected {_FEWEST_PLACED:.0%} and {_FEWEST_POINTS} or more; not placed: "
            f"{', '.join(missing[:3]) or 'none'}. Take more photographs in between, of a scene with more texture"
        )
    error = float(found.compute_mean_reprojection_error())
    if error > _LARGEST_ERROR_PX:
        raise CameraError(
            f"{photographs[0].parent}: points lie {error:.2g} pixels from where they are seen, expected at most "
            f"{_LARGEST_ERROR_PX:g}; did the scene move, or the zoom change?"
        )
    matrices = np.tile(np.eye(4), (len(placed), 1, 1))
    matrices[:, :3] = [poses[names[path]] for path in placed]
    camera = known or _intrinsics(next(iter(found.cameras.values())), str(photographs[0].parent))
    return Structure(placed, matrices, camera, points, error)


def _intrinsics(camera: Any, where: str) -> Intrinsics:
    """Intrinsics of a SIMPLE_RADIAL camera: one focal length, the centre, and k1."""
    matrix = np.array(camera.calibration_matrix())
    matrix[:2, 2] -= 0.5
    k1 = float(camera.params[3])
    checked = check_matrix(matrix, camera.width, camera.height, f"{where}, by structure from motion")
    return Intrinsics(checked, camera.width, camera.height, (k1, 0.0, 0.0, 0.0, 0.0))
