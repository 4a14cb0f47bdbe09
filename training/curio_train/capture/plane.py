"""The plane that parts stand on: camera poses over it, its points at each pixel, and the pixels that ever changed.

The world's frame is that of ``--calibrate --views-out``: y up, the plane at y = 0, metres.
"""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from curio_serve.planes import camera_poses
from scipy.spatial.transform import Rotation

from curio_train.errors import CameraError, DataError

_SAME_TILT_DEG, _SAME_HEIGHT = 2.0, 0.05
_MAX_DISTANCE = 3.0  # of points on the plane, relative to the one on the optical axis
_MIN_CHANGE = 0.1  # of sRGB: noise, exposure and the rims of soft shadows stay below
_MIN_PHOTOGRAPHS = 0.02  # fraction of the photographs in which a pixel changed
_MIN_AREA = 0.002  # fraction of the frame


class CameraPoseFile(camera_poses.CameraPoseFile):
    """The same file beside photographs that are learned from.

    If the camera moves, each photograph may name a background image of its own as ``"plate": "plates/a.png"``.
    """

    error = CameraError

    def in_metres(self, photograph: Path) -> bool:
        """Whether the file has a pose of this photograph in metres."""
        return self._entry(photograph).get("unit") == "m"

    def background_image(self, photograph: Path) -> Path | None:
        """The photograph's own image of the empty scene, if it has one."""
        name = self._entry(photograph).get("plate")
        return None if name is None else self.file.parent / str(name)

    @property
    def background_images(self) -> list[Path]:
        """All images of the empty scene that photographs name as their own."""
        names = (entry.get("plate") for entry in self.entries.values())
        return [self.file.parent / str(name) for name in names if name is not None]

    def check_same_viewpoint(self, photograph: Path, background: Path) -> None:
        """Refuse a photograph taken from another height or tilt than the background image, or from another place.

        The azimuth may differ where the photograph names its own image of the empty scene.

        Raises:
            CameraError: Says how they differ.
        """
        if not self.is_known(photograph):
            return
        one, other = (self.pose_above_plane(path) for path in (photograph, background))
        tilt = float(np.degrees(np.arccos(np.clip(one[:3, 1] @ other[:3, 1], -1, 1))))
        heights = [float((-matrix[:3, :3].T @ matrix[:3, 3])[1]) for matrix in (one, other)]
        if tilt > _SAME_TILT_DEG or abs(heights[0] / heights[1] - 1) > _SAME_HEIGHT:
            raise CameraError(
                f"{self.flag} {self.file}: {photograph.name} was taken {heights[0]:.3g} m above the plane and tilted "
                f"by {tilt:.1f} degrees to {background.name}, taken at {heights[1]:.3g} m; a camera that moves has to "
                f"keep its height within {_SAME_HEIGHT:.0%} and its tilt within {_SAME_TILT_DEG:g} degrees"
            )
        turned = np.degrees(Rotation.from_matrix(one[:3, :3] @ other[:3, :3].T).magnitude())
        centers = [-matrix[:3, :3].T @ matrix[:3, 3] for matrix in (one, other)]
        moved_m = float(np.linalg.norm(centers[0] - centers[1]))
        is_elsewhere = turned > _SAME_TILT_DEG or moved_m > _SAME_HEIGHT * heights[1]
        if is_elsewhere and self.background_image(photograph) is None:
            raise CameraError(
                f"{self.flag} {self.file}: {photograph.name} was taken {moved_m:.3g} m beside {background.name} and "
                f"turned by {turned:.0f} degrees to it, so that image does not show the scene behind its parts; name "
                'an image of the empty scene from there as its "plate"'
            )


def points_on_plane(matrix: np.ndarray, cam_from_world: np.ndarray, width: int, height: int) -> np.ndarray:
    """The point of the plane at each pixel, metres, world frame.

    Args:
        matrix: K [3, 3].
        cam_from_world: [4, 4].
        width: Of the image, pixels.
        height: Of the image, pixels.

    Returns:
        [height, width, 3]; NaN above the horizon and far beyond the scene.
    """
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1).astype(np.float64)
    rotation, centre = cam_from_world[:3, :3], -cam_from_world[:3, :3].T @ cam_from_world[:3, 3]
    rays = pixels @ np.linalg.inv(matrix).T @ rotation
    with np.errstate(divide="ignore", invalid="ignore"):
        along = -centre[1] / rays[..., 1]
    farthest = -_MAX_DISTANCE * centre[1] / rotation[2, 1]
    along[~((along > 0) & (along <= farthest))] = np.nan
    points: np.ndarray = centre + along[..., None] * rays
    points[..., 1] = np.where(np.isnan(along), np.nan, 0.0)
    return points


def changed_pixels(photographs: Sequence[np.ndarray], backgrounds: Sequence[np.ndarray]) -> np.ndarray:
    """Pixels that differ from the background image in more than a few photographs: things ever were there.

    Args:
        photographs: Each [3, height, width] uint8.
        backgrounds: The background image of each.

    Returns:
        Mask [height, width].

    Raises:
        DataError: There are next to none.
    """
    changes = [_change(photo, background) for photo, background in zip(photographs, backgrounds, strict=True)]
    often = (np.mean([change > _MIN_CHANGE for change in changes], axis=0) > _MIN_PHOTOGRAPHS).astype(np.uint8)
    mask: np.ndarray = cv2.morphologyEx(often, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)).astype(bool)
    if mask.mean() < _MIN_AREA:
        raise DataError(
            f"the {len(photographs)} photographs show nothing but the background (a change on {mask.mean():.2%} of the "
            "frame); expected parts in them, and --background without"
        )
    return mask


def _change(photograph: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Largest difference of a channel after smoothing and equalising the exposures, [height, width] in [0, 1]."""
    photo, empty = (
        cv2.GaussianBlur(image.transpose(1, 2, 0).astype(np.float32) / 255, (5, 5), 0)
        for image in (photograph, background)
    )
    gain = np.median(photo, axis=(0, 1)) / np.maximum(np.median(empty, axis=(0, 1)), 1e-3)
    change: np.ndarray = np.abs(photo - empty * gain).max(axis=2)
    return change
