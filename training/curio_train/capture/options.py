"""What a user may choose about calibration, as plain data: the flags of ``curio-train capture --calibrate``."""

from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class CalibrateCommand:
    """Find out a camera from photographs of a board, or of any still scene with texture.

    Attributes:
        images: Folder of photographs, taken with one camera at one zoom.
        calibrate: This command.
        board: Squares of a chessboard or ChArUco board along and across. Without, photographs of a still scene are
            matched with each other (structure from motion), and the first has to look down on a table or floor.
        square_mm: Side of a square.
        marker_mm: Side of a ChArUco marker; a plain chessboard has none.
        dictionary: OpenCV's name of the markers' dictionary.
        camera: The camera, where it is known and only its places are wanted.
        every: Take each so many-th photograph of a sequence.
        distance_m: Distance of the first and the last camera, for poses in metres.
        objects: For poses in metres, too: folder with a model or run for each LineMOD object that the scene shows.
        data: Their data folder.
        camera_out: The camera file to write.
        views_out: File for where each photograph was taken: cam_from_world, y up, origin on the ground.
    """

    images: Path
    calibrate: tyro.conf.FlagCreatePairsOff[bool] = False
    board: tuple[int, int] | None = None
    square_mm: float = 30.0
    marker_mm: float | None = None
    dictionary: str = "DICT_4X4_50"
    camera: Path | None = None
    every: int = 1
    distance_m: float | None = None
    objects: Path | None = None
    data: Path | None = None
    camera_out: Path = Path("camera.json")
    views_out: Path | None = None
