"""Contact sheets like the paper's figure "LineMod": true boxes in green above, predicted ones in red below.

They show frames of the data set, so they go where the user says and never into this repository.
"""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from curio_train.data.bop import Annotation, BopDataset
from curio_train.data.bop_split import scored_frames
from curio_train.data.photographs import read_photograph
from curio_train.errors import UsageError
from curio_train.evaluation.real_frames import estimate_frames
from curio_train.evaluation.real_scores import VISIBLE
from curio_train.evaluation.subject import Subject
from curio_train.geometry import Pose

_GREEN, _RED = (0, 200, 0), (230, 0, 0)
_THICKNESS_PX = 2
_SHOWN_DIAMETERS = 3.0  # a side of the picture, around the object


def write_sheet(subject: Subject, data: Path, file: Path, num_frames: int) -> None:
    """Draw some frames of the object, spread over the targets that are seen well, or over all where that is unknown.

    Args:
        subject: Reads poses of one object.
        data: Real frames in BOP's layout.
        file: PNG to write.
        num_frames: Columns, at most.

    Raises:
        UsageError: The file cannot be written.
        DataError: The data set is incomplete.
    """
    dataset, kind = BopDataset(data), subject.world.objects[0]
    targets = scored_frames(dataset, kind.name).targets
    seen = [target for target in targets if (target.visible_fraction or 0) >= VISIBLE] or list(targets)
    chosen = _spread(seen, num_frames)
    columns = []
    for estimate, target in zip(estimate_frames(subject, dataset, chosen), chosen, strict=True):
        pixels, matrix = read_photograph(estimate.frame.path), estimate.frame.matrix
        drawn = [
            _drawn(pixels, pose, kind.box_corners_m, matrix, colour)
            for pose, colour in ((target.pose, _GREEN), (estimate.pose, _RED))
        ]
        columns.append(np.vstack([_around(picture, target.pose, kind.diameter_m, matrix) for picture in drawn]))
    sheet = np.hstack(columns)
    done, encoded = cv2.imencode(".png", sheet[..., ::-1])
    assert done  # PNG takes any picture
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(encoded.tobytes())
    except OSError as exc:
        raise UsageError(f"--sheets: cannot write {file}: {exc.strerror}; name a folder that can be written") from exc


def _spread(targets: Sequence[Annotation], count: int) -> list[Annotation]:
    positions = np.linspace(0, len(targets) - 1, min(count, len(targets))).round().astype(int)
    return [targets[position] for position in positions]


def _drawn(
    pixels: np.ndarray, pose: Pose, corners_m: np.ndarray, matrix: np.ndarray, colour: tuple[int, int, int]
) -> np.ndarray:
    """The picture with the edges of the object's box; of an edge that reaches behind the camera nothing."""
    picture = pixels.copy()
    in_camera = pose.apply(corners_m)
    for one in range(8):
        for other in (one ^ 1, one ^ 2, one ^ 4):  # corners are numbered by their three coordinates' bits
            ends = in_camera[[one, other]]
            if one < other and (ends[:, 2] > 0.01).all():
                homogeneous = ends @ matrix.T
                places = np.clip(homogeneous[:, :2] / homogeneous[:, 2:], -1e4, 1e4).round().astype(int)
                cv2.line(picture, places[0].tolist(), places[1].tolist(), colour, _THICKNESS_PX, cv2.LINE_AA)
    return picture


def _around(picture: np.ndarray, pose: Pose, diameter_m: float, matrix: np.ndarray, side_px: int = 160) -> np.ndarray:
    """A square around the true place, as large as the object's surroundings."""
    x, y, z = matrix @ pose.translation_m
    reach = _SHOWN_DIAMETERS * diameter_m * matrix[0, 0] / z
    scale = side_px / reach
    window = np.array([[scale, 0, side_px / 2 - scale * x / z], [0, scale, side_px / 2 - scale * y / z]])
    return cv2.warpAffine(picture, window, (side_px, side_px), flags=cv2.INTER_LINEAR)
