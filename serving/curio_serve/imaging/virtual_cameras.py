"""Virtual cameras that are turned and zoomed a little, so that a network reads one image several times.

This is test-time augmentation: a network's errors on photographs change with each pixel that an object moves. Turning a
camera about its centre changes its image by a homography alone, and so does another focal length, so each warped image
is the one that such a camera would have taken, and its poses are brought back exactly.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from curio_serve.imaging.rotation import from_rotation_vector, smallest_rotation

Array = np.ndarray
_AXES = np.array([[0.0, 0, 1], [0, 1, 0], [1, 0, 0]])  # of roll, pan and tilt


@dataclass(frozen=True)
class VirtualCamera:
    """A camera at the place of the real one."""

    roll_deg: float = 0.0
    """Turn about the optical axis."""
    zoom: float = 1.0
    """Factor on the focal length; depths that are read as if it were 1 are too small by this factor."""
    pan_deg: float = 0.0
    """Turn about the image's y axis."""
    tilt_deg: float = 0.0
    """Turn about its x axis."""

    @property
    def virtual_from_cam(self) -> Array:
        """Rotation [3, 3]."""
        angles = np.radians([self.roll_deg, self.pan_deg, self.tilt_deg])
        roll, pan, tilt = from_rotation_vector(angles[:, None] * _AXES)
        result: Array = roll @ pan @ tilt
        return result

    def image(self, pixels: Array, matrix: Array) -> Array:
        """What this camera sees; beyond the frame its edge pixels continue.

        Args:
            pixels: uint8 RGB [height, width, 3].
            matrix: K [3, 3] of them.
        """
        if self == VirtualCamera():
            return pixels
        homography = matrix @ np.diag([self.zoom, self.zoom, 1.0]) @ self.virtual_from_cam @ np.linalg.inv(matrix)
        size = pixels.shape[1], pixels.shape[0]
        return cv2.warpPerspective(pixels, homography, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def back(self, rotation: Array, translation_m: Array) -> tuple[Array, Array]:
        """A pose read from this camera's image as if it had K, in the real camera's frame.

        Where the camera is zoomed, an object appears in another direction than it has: the rotation that it appears
        with is kept along its ray.

        Args:
            rotation: cam_from_obj [3, 3].
            translation_m: [3], in front of the camera.
        """
        cam_from_virtual = self.virtual_from_cam.T
        true_m = translation_m * np.array([1.0, 1.0, self.zoom])
        turned = smallest_rotation(_unit(translation_m), _unit(true_m))
        return cam_from_virtual @ turned @ rotation, cam_from_virtual @ true_m


def _unit(vector: Array) -> Array:
    result: Array = vector / np.linalg.norm(vector)
    return result


VIRTUAL_CAMERAS = (
    VirtualCamera(),
    VirtualCamera(roll_deg=8),
    VirtualCamera(roll_deg=-8),
    VirtualCamera(zoom=1.06),
    VirtualCamera(zoom=0.94),
    VirtualCamera(pan_deg=2),
    VirtualCamera(roll_deg=8, zoom=1.06),
    VirtualCamera(roll_deg=-8, zoom=1.06),
    VirtualCamera(pan_deg=-2, tilt_deg=1),
)
"""The real camera itself, and others in the order in which images are read through them."""
