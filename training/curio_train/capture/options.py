"""What a user may choose about calibration and about taking photographs, as plain data."""

from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class CalibrateCommand:
    """Find out a camera from photographs of a board, or of any still scene with texture."""

    images: Path
    """Folder of photographs, taken with one camera at one zoom."""
    calibrate: tyro.conf.FlagCreatePairsOff[bool] = False
    """This command."""
    board: tuple[int, int] | None = None
    """Squares of a chessboard or ChArUco board along and across; of a chessboard also its inner corners, as OpenCV
    counts. Without, photographs of a still scene are matched with
    each other (structure from motion), and the first has to look down on a table or floor."""
    square_mm: float = 30.0
    """Side of a square."""
    marker_mm: float | None = None
    """Side of a ChArUco marker; a plain chessboard has none."""
    dictionary: str = "DICT_4X4_50"
    """OpenCV's name of the markers' dictionary."""
    camera: Path | None = None
    """Camera file, where K and lens are known and only the camera's poses are wanted."""
    every: int = 1
    """Take every N-th photograph of a sequence."""
    distance_m: float | None = None
    """Distance between the first and the last camera in metres; poses are then in metres, too."""
    objects: Path | None = None
    """For poses in metres, too: model or run of the LineMOD objects that the scene shows, or a folder with one of
    each."""
    data: Path | None = None
    """Their data folder."""
    rig_out: Path | None = None
    """Several cameras: the folder has one of each, which show --board at the same instants under the same names. File
    to write for curio-detect --rig: each camera and where it stands."""
    plane_out: Path | None = None
    """With --board: file for curio-detect --plane: where the camera stands over the board in the last photograph, by
    name. Lay the board where objects will stand."""
    camera_out: Path | None = None
    """The camera file to write. None: camera.json; from a scene only where there is no such file yet."""
    views_out: Path | None = None
    """File for where each photograph was taken: cam_from_world, y up, origin on the ground."""


@dataclass(frozen=True)
class AssistantCommand:
    """Take photographs of a part, or of a calibration board, with a camera that is watched.

    Sharp, well exposed frames that differ from those already kept become files, until there are enough. The frames, and
    what is wrong with them, are shown in the browser on this machine alone.
    """

    out: Path
    """Folder for the photographs; those that are there count."""
    assistant: tyro.conf.FlagCreatePairsOff[bool] = False
    """This command."""
    video: str = "0"
    """A camera's number, a video file, or a folder of photographs."""
    board: tuple[int, int] | None = None
    """Squares, or inner corners, of a chessboard or ChArUco board along and across: only frames that show it are
    kept."""
    marker_mm: float | None = None
    """Side of a ChArUco marker, where squares have 30 mm; a plain chessboard has none."""
    dictionary: str = "DICT_4X4_50"
    """OpenCV's name of the markers' dictionary."""
    background: Path | None = None
    """Photograph of the empty scene by the camera as it stands: only frames that differ from it are kept. Where there
    is none, the first good frame becomes it: leave the part away until it is taken."""
    count: int | None = None
    """How many are enough. None: 80 of a part, from which on a model learns from them, and 20 of a board."""
    port: int = 8080
    """Port of the page, on 127.0.0.1."""
