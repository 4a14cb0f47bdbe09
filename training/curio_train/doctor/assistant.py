"""Chooses photographs among the frames of a camera: sharp, well exposed, unlike those already kept."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from curio_train.capture.calibration import Board
from curio_train.data.background_difference import compare
from curio_train.data.photographs import SUFFIXES, image_files, read_photograph
from curio_train.doctor.picture_content import BLURRED, MOSTLY_LOST, sharpness_and_exposure, thumbnail
from curio_train.errors import DataError, UsageError

_LEAST_DIFFERENCE = 30.0  # levels of 255 in one of 64x64 places: more than noise and flicker
_LEAST_IN_SIGHT = 0.002  # fraction of the frame that differs from the empty scene
_SMALL = (160, 120)


@dataclass(frozen=True)
class Judgement:
    """What was found out about one frame."""

    blur: float
    """0 sharp to 1 blurred."""
    lost: float
    """Fraction of the pixels that are black or white."""
    difference: float
    """Largest difference between a frame's thumbnail and that of the most similar kept photograph, levels of 255."""
    board: bool | None
    """Whether the board is seen; None: none is looked for."""
    in_sight: float | None
    """Fraction that differs from the empty scene; None: there is no photograph of it."""
    fault: str
    """Why the frame is not kept; empty where it is."""


class Assistant:
    """Keeps good frames as files in a folder."""

    num_kept: int
    """Photographs in the folder, those of earlier calls included, without the empty scene."""

    def __init__(self, folder: Path, board: Board | None, background: Path | None) -> None:
        """Look at what is there.

        Args:
            folder: For the photographs; made where it is missing.
            board: That frames have to show.
            background: Photograph of the empty scene; one that does not exist is taken first.

        Raises:
            DataError: The folder, a photograph or the background's path cannot be used, or they differ in size.
            UsageError: The background's name does not say what kind of image it is to be.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
            there, _ = image_files(folder, () if background is None else (background,))
        except OSError as exc:
            raise DataError(f"--out {folder}: cannot be made or read: {exc.strerror}") from exc
        self._folder, self._board, self._background = folder, board, background
        self._first: tuple[str, int, int] | None = None
        self._empty: torch.Tensor | None = None
        if background is not None:
            self._look_at_background(background)
        self._kept = [thumbnail(self._read(path)) for path in there]
        self.num_kept = len(self._kept)

    @property
    def wants_background(self) -> bool:
        """Whether the next good frame becomes the photograph of the empty scene."""
        return self._background is not None and self._empty is None

    def take(self, pixels: np.ndarray) -> Judgement:
        """Judge a frame, and keep it where it is good.

        Args:
            pixels: uint8 RGB [height, width, 3].

        Raises:
            DataError: The file cannot be written, or the frame is not of the photographs' size.
        """
        self._check_size("this frame", pixels)
        seen = thumbnail(pixels)
        judgement = self._judge(pixels, seen)
        if judgement.fault:
            return judgement
        if self._background is not None and self._empty is None:
            _write(self._background, pixels)
            self._empty = _small(pixels)
            return judgement
        number = self.num_kept
        while (path := self._folder / f"photo_{number:04d}.jpg").exists():
            number += 1
        _write(path, pixels)
        self._kept.append(seen)
        self.num_kept = len(self._kept)
        return judgement

    def _look_at_background(self, background: Path) -> None:
        if _exists(background):
            self._empty = _small(self._read(background))
        elif background.suffix.lower() not in SUFFIXES:
            raise UsageError(f"--background {background}: expected a file name that ends in {' '.join(SUFFIXES)}")

    def _read(self, path: Path) -> np.ndarray:
        pixels = read_photograph(path)
        self._check_size(str(path), pixels)
        return pixels

    def _check_size(self, name: str, pixels: np.ndarray) -> None:
        height, width = pixels.shape[:2]
        if self._first is None:
            self._first = (name, width, height)
        first, *size = self._first
        if [width, height] != size:
            raise DataError(
                f"{name} has {width}x{height} pixels, but {first} has {size[0]}x{size[1]}; one camera has to take all "
                "in one size: set its resolution, or choose other places for the new ones: --out and --background"
            )

    def _judge(self, pixels: np.ndarray, seen: np.ndarray) -> Judgement:
        blur, lost = sharpness_and_exposure(pixels)
        difference = min((float(np.abs(seen - kept).max()) for kept in self._kept), default=255.0)
        in_sight = None
        if self._empty is not None:
            in_sight = float(compare(_small(pixels)[None], self._empty).differs.float().mean())
        board, fault = None, ""
        if lost > MOSTLY_LOST:
            fault = "mostly black or white: change the exposure"
        elif blur > BLURRED:
            fault = "blurred: hold still, focus, or use more light"
        elif in_sight is not None and in_sight < _LEAST_IN_SIGHT:
            fault = "like the empty scene: put the part into the frame"
        elif not self.wants_background and difference < _LEAST_DIFFERENCE:
            fault = "like a photograph that was kept: move the part or the camera"
        elif self._board is not None and not (board := self._shows_board(pixels)):
            fault = "no board found: show all of it, flat and without glare"
        return Judgement(blur, lost, difference, board, in_sight, fault)

    def _shows_board(self, pixels: np.ndarray) -> bool:
        assert self._board is not None
        grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
        return any(reading.find(grey) is not None for reading in self._board.readings)


def _exists(background: Path) -> bool:
    try:
        background.stat()
    except FileNotFoundError:
        return False
    except OSError as exc:
        raise DataError(f"--background {background}: cannot be reached ({exc.strerror}); name another file") from exc
    return True


def _small(pixels: np.ndarray) -> torch.Tensor:
    small = cv2.resize(pixels, _SMALL, interpolation=cv2.INTER_AREA)
    return torch.from_numpy(small).permute(2, 0, 1).float() / 255


def _write(path: Path, pixels: np.ndarray) -> None:
    kind = path.suffix.lower()
    options = [cv2.IMWRITE_JPEG_QUALITY, 95] if kind in (".jpg", ".jpeg") else []
    _, encoded = cv2.imencode(kind, cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), options)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encoded.tobytes())
    except OSError as exc:
        raise DataError(f"{path}: cannot be written: {exc.strerror}; make room, or choose another folder") from exc
