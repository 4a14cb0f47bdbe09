"""Pictures for people: posed objects through stock Mitsuba's path tracer, with all the light that it follows."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from curio_train.meshes.gltf import srgb_from_linear
from curio_train.rendering.ground import Ground
from curio_train.rendering.parts import linear_from_srgb
from curio_train.rendering.stock import PosedMesh, emitters, load_scene, sensor
from curio_train.rendering.variant import load_mitsuba

MAX_BOUNCES = 8
GROUND_RADIUS_M = 50.0


def path_traced(
    objects: Sequence[PosedMesh],
    camera_matrix: np.ndarray,
    width: int,
    height: int,
    *,
    ambient: float,
    light: np.ndarray,
    ground: Ground | None,
    samples_per_pixel: int,
) -> np.ndarray:
    """Trace a picture.

    Args:
        objects: In the camera's frame.
        camera_matrix: K [3, 3] without skew; pixel centres at integers.
        width: Of the picture, pixels.
        height: Of the picture, pixels.
        ambient: Radiance from everywhere.
        light: Camera frame, towards the light; its length is the strength.
        ground: Plane below, or None.
        samples_per_pixel: Paths a pixel.

    Returns:
        [height, width, 4] float32: colour in sRGB, not premultiplied, and alpha, which is 0 where nothing was hit.

    Raises:
        RendererError: No usable libLLVM.
    """
    mitsuba = load_mitsuba()
    # Mitsuba's pixels are square: the film gets as many lines as square pixels need, and is squeezed afterwards.
    stretch = camera_matrix[0, 0] / camera_matrix[1, 1]
    square = np.array(camera_matrix, dtype=np.float64)
    square[1, 1] = square[0, 0]
    square[1, 2] = (square[1, 2] + 0.5) * stretch - 0.5
    film_height = int(np.ceil(height * stretch))
    camera = sensor(mitsuba, square, width, film_height, samples_per_pixel)
    around: dict[str, Any] = {
        **emitters(ambient, light),
        **({"ground": ground_disk(mitsuba, ground)} if ground else {}),
    }
    integrator = {"type": "path", "max_depth": MAX_BOUNCES, "hide_emitters": True}
    image = np.array(mitsuba.render(load_scene(mitsuba, objects, camera, around, integrator), spp=samples_per_pixel))
    rows_to_film = np.array([[1, 0, 0], [0, stretch, (stretch - 1) / 2]])
    image = cv2.warpAffine(
        image,
        rows_to_film,
        (width, height),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    alpha = image[..., 3:].clip(0, 1)
    linear = np.where(alpha > 0, image[..., :3] / np.maximum(alpha, 1e-6), 0).clip(0, 1)
    return np.concatenate([srgb_from_linear(linear), alpha], axis=2).astype(np.float32)


def ground_disk(mitsuba: Any, ground: Ground) -> dict[str, Any]:
    """Mitsuba's unit disk, brought below the camera."""
    up = np.asarray(ground.up, dtype=np.float64)
    location, linear = -ground.camera_height_m * up, float(linear_from_srgb(np.array(ground.albedo_srgb)))
    transform = mitsuba.ScalarTransform4f
    side = np.eye(3)[np.argmin(np.abs(up))]
    to_world = transform().look_at(origin=location.tolist(), target=(location + up).tolist(), up=side.tolist())
    reflectance = {"type": "rgb", "value": linear}
    return {
        "type": "disk",
        "to_world": to_world @ transform().scale(GROUND_RADIUS_M),
        "bsdf": {"type": "twosided", "material": {"type": "diffuse", "reflectance": reflectance}},
    }
