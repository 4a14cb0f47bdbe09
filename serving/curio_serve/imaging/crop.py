"""Crops of frames by virtual cameras at the frame's camera, as networks are trained on them."""

import cv2
import numpy as np

from curio_serve.imaging.camera import PinholeCamera, scaling

Array = np.ndarray
_OVERSAMPLING = 2  # as in training: each pixel of a crop is the mean of four samples


def cut_crop(
    pixels: Array,
    camera: PinholeCamera,
    crop_from_cam: Array,
    focal_px: float,
    side_px: int,
    canonical_focal_px: float,
) -> Array:
    """A crop by a virtual camera at the frame's camera, each pixel the mean of four samples.

    Args:
        pixels: uint8 RGB [height, width, 3].
        camera: That took them.
        crop_from_cam: Rotation [3, 3].
        focal_px: Of the crop; its principal point is its middle.
        side_px: Of the crop.
        canonical_focal_px: Frames of a longer focal length are averaged down to this one.

    Returns:
        uint8 RGB [side_px, side_px, 3]; beyond the frame its edge pixels continue.
    """
    fine = _OVERSAMPLING * side_px
    middle, focal = (fine - 1) / 2, _OVERSAMPLING * focal_px
    target = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]])
    matrix = camera.matrix
    reduced = round(max(1.0, camera.focal_lengths[0] / canonical_focal_px))
    if reduced > 1:
        pixels = cv2.resize(pixels, None, fx=1 / reduced, fy=1 / reduced, interpolation=cv2.INTER_AREA)
        matrix = scaling(1 / reduced, 1 / reduced) @ matrix
    if camera.coefficients is not None:
        maps = cv2.initUndistortRectifyMap(
            matrix, camera.coefficients, crop_from_cam, target, (fine, fine), cv2.CV_32FC1
        )
        image = cv2.remap(pixels, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    else:
        frame_from_crop = matrix @ crop_from_cam.T @ np.linalg.inv(target)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        image = cv2.warpPerspective(pixels, frame_from_crop, (fine, fine), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return cv2.resize(image, (side_px, side_px), interpolation=cv2.INTER_AREA)
