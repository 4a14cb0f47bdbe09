"""The canonical camera: a scene seen by the frame's camera and by the model's agree, and poses come back."""

from itertools import product

import numpy as np
import pytest
from curio_serve.errors import CameraError
from curio_serve.imaging.camera import PinholeCamera, scaling
from curio_serve.imaging.rotation import quaternion_xyzw, smallest_rotation
from curio_serve.imaging.view import CanonicalCamera, FlatFrame, PinholeFrame, Region, searched_fraction
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

CANONICAL = CanonicalCamera(128, 96, np.array([[140.0, 0, 66.0], [0, 143.0, 45.0], [0, 0, 1]]))
K = np.array([[640.0, 0, 350.0], [0, 650.0, 230.0], [0, 0, 1]])
DISTORTION = (-0.25, 0.08, 0.001, -0.002, 0.0)


def _dot_picture(width: int, height: int, pixels: np.ndarray, sigma: float) -> np.ndarray:
    """uint8 RGB: soft dots at pixels [n, 2]."""
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    image = np.zeros((height, width))
    for x, y in pixels:
        image += np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2))
    return np.repeat((255 * np.clip(image, 0, 1)).round().astype(np.uint8)[..., None], 3, axis=2)


def _centroid_near(image: np.ndarray, x: float, y: float, radius: int = 6) -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(image.shape[1]), np.arange(image.shape[0]))
    weight = image[..., 0] * ((columns - x) ** 2 + (rows - y) ** 2 < radius**2)
    return np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()


@pytest.mark.parametrize("size", [(128, 96), (640, 480), (1280, 960), (100, 75)])
def test_frames_of_the_training_camera_are_merely_resized(size: tuple[int, int]) -> None:
    assert CANONICAL.matrix is not None
    scale = scaling(size[0] / CANONICAL.width, size[1] / CANONICAL.height)
    pixels = np.random.default_rng(0).integers(0, 255, (size[1], size[0], 3)).astype(np.uint8)
    view = PinholeFrame(pixels, PinholeCamera(scale @ CANONICAL.matrix), CANONICAL).crop(Region(0, 0, *size))
    np.testing.assert_allclose(view.canonical_from_cam, np.eye(3), atol=1e-12)
    if size == (128, 96):
        np.testing.assert_array_equal(view.image, pixels)
    if size == (1280, 960):
        blocks = pixels.reshape(96, 10, 128, 10, 3).mean(axis=(1, 3))
        assert np.abs(view.image - blocks).max() <= 1


@pytest.mark.parametrize("distortion", [(), DISTORTION])
@pytest.mark.parametrize("reduction", [1, 2])
@pytest.mark.parametrize(
    "region", [Region(0, 0, 640, 480), Region(400, 100, 150, 120), Region(-60, 300, 200, 250), Region(3, 5, 2, 2)]
)
def test_a_scene_looks_the_same_through_both_cameras(
    region: Region, reduction: int, distortion: tuple[float, ...]
) -> None:
    """Dots drawn where the frame's camera sees points appear where the model's camera sees the turned points."""
    assert CANONICAL.matrix is not None
    camera = PinholeCamera(K, distortion)
    grid = np.array([[x, y, 1.0] for x in np.arange(-0.4, 0.41, 0.2) for y in np.arange(-0.3, 0.31, 0.2)])
    points = grid * np.random.default_rng(1).uniform(0.5, 3, (len(grid), 1))
    drawn = scaling(1 / reduction, 1 / reduction)
    pixels = camera.project(points) @ drawn[:2, :2].T + drawn[:2, 2]
    picture = _dot_picture(640 // reduction, 480 // reduction, pixels, 6 / reduction)
    view = PinholeFrame(picture, camera, CANONICAL, reduction).crop(region)
    seen = points @ view.canonical_from_cam.T @ CANONICAL.matrix.T
    seen = seen[:, :2] / seen[:, 2:]
    inside = np.all((seen > 8) & (seen < [119, 87]), axis=1) & np.all(
        (pixels > 20 / reduction) & (pixels < np.array([619, 459]) / reduction), axis=1
    )
    assert inside.sum() >= 2
    for x, y in seen[inside]:
        np.testing.assert_allclose(_centroid_near(view.image, x, y), [x, y], atol=0.15)


@pytest.mark.parametrize("region", [Region(0, 0, 640, 480), Region(400, 100, 150, 120)])
def test_poses_come_back(region: Region) -> None:
    view = PinholeFrame(np.zeros((480, 640, 3), np.uint8), PinholeCamera(K), CANONICAL).crop(region)
    turn = view.canonical_from_cam
    truth = np.array([[0.1, -0.2, 1.3], [0.0, 0.3, 0.8]])
    for position in truth:
        np.testing.assert_allclose(view.translation((turn @ position).tolist()), position, atol=1e-12)
    rotations = np.stack([np.eye(3), smallest_rotation(np.array([0, 0, 1.0]), np.array([0.6, 0, 0.8]))])
    for rotation in rotations:
        np.testing.assert_allclose(view.rotate((turn @ rotation).tolist()), rotation.ravel(), atol=1e-12)


@pytest.mark.parametrize("distortion", [(), DISTORTION])
def test_a_cached_warp_equals_a_new_one(distortion: tuple[float, ...]) -> None:
    """What is kept of a camera belongs to that size, region and model alone."""
    camera, random = PinholeCamera(K, distortion), np.random.default_rng(2)
    large = CanonicalCamera(160, 120, scaling(1.25, 1.25) @ np.asarray(CANONICAL.matrix))
    frames = [(random.integers(0, 255, (480 // r, 640 // r, 3)).astype(np.uint8), r) for r in (1, 2, 1)]
    regions = [Region(0, 0, 640, 480), Region(400, 100, 150, 120)]
    for (pixels, reduction), region, canonical in product(frames, regions, (CANONICAL, large)):
        kept = PinholeFrame(pixels, camera, canonical, reduction).crop(region)
        new = PinholeFrame(pixels, PinholeCamera(K, distortion), canonical, reduction).crop(region)
        np.testing.assert_array_equal(kept.image, new.image)
        np.testing.assert_array_equal(kept.canonical_from_cam, new.canonical_from_cam)


def test_a_region_brings_its_centre_to_the_middle() -> None:
    assert CANONICAL.matrix is not None
    region = Region(400, 100, 150, 120)
    view = PinholeFrame(np.zeros((480, 640, 3), np.uint8), PinholeCamera(K, DISTORTION), CANONICAL).crop(region)
    ray = PinholeCamera(K, DISTORTION).ray(400 + 75 - 0.5, 100 + 60 - 0.5)
    pixel = CANONICAL.matrix @ view.canonical_from_cam @ ray
    np.testing.assert_allclose(pixel[:2] / pixel[2], [63.5, 47.5], atol=1e-6)


unit_forward = st.tuples(st.floats(-5, 5), st.floats(-5, 5)).map(
    lambda slopes: np.array([*slopes, 1.0]) / np.linalg.norm([*slopes, 1.0])
)


@settings(deadline=None)
@given(unit_forward, unit_forward)
def test_the_smallest_rotation_is_one_and_is_smallest(source: np.ndarray, target: np.ndarray) -> None:
    turn = smallest_rotation(source, target)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(turn) == pytest.approx(1)
    np.testing.assert_allclose(turn @ source, target, atol=1e-9)
    # Trace is 1 + 2 cos(angle), and no rotation between them has a smaller angle than theirs.
    assert (np.trace(turn) - 1) / 2 == pytest.approx(source @ target, abs=1e-9)


@settings(deadline=None)
@given(st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 1e-3))
def test_quaternions_are_those_of_scipy(values: tuple[float, ...]) -> None:
    matrix = Rotation.from_quat(values).as_matrix()
    found = np.array(quaternion_xyzw(matrix.ravel().tolist()))
    assert np.linalg.norm(found) == pytest.approx(1)
    assert found[3] >= 0
    np.testing.assert_allclose(Rotation.from_quat(found).as_matrix(), matrix, atol=1e-9)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, 0, 0.8), (-0.6, 0, 0.8)])
def test_half_turns_have_quaternions(axis: tuple[float, ...]) -> None:
    matrix = Rotation.from_rotvec(np.pi * np.array(axis)).as_matrix()
    np.testing.assert_allclose(np.abs(quaternion_xyzw(matrix.ravel().tolist())), np.abs([*axis, 0]), atol=1e-7)


def test_views_behind_the_camera_are_refused() -> None:
    wide = PinholeCamera(np.array([[70.0, 0, 320], [0, 70.0, 240], [0, 0, 1]]))
    frame = PinholeFrame(np.zeros((480, 640, 3), np.uint8), wide, CANONICAL)
    frame.crop(Region(0, 0, 640, 480))
    with pytest.raises(CameraError, match="87 degrees"):
        frame.crop(Region(0, 0, 20, 20))


@pytest.mark.parametrize(("focal_px", "expected"), [(600, 1.0), (500, 1.0), (475, 0.902), (437, 0.764), (250, 0.25)])
def test_of_a_wide_frame_the_middle_is_searched(focal_px: float, expected: float) -> None:
    own = CanonicalCamera(64, 48, np.array([[50.0, 0, 31.5], [0, 50, 23.5], [0, 0, 1]]))
    camera = PinholeCamera(np.array([[focal_px, 0, 319.5], [0, focal_px, 239.5], [0, 0, 1]]))
    assert searched_fraction(camera, own, 640, 480) == pytest.approx(expected, abs=0.02)


def test_flat_frames_are_averaged_to_size() -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (480, 640, 3)).astype(np.uint8)
    image = FlatFrame(pixels, CanonicalCamera(64, 48)).crop(Region(0, 0, 640, 480)).image
    blocks = pixels.reshape(48, 10, 64, 10, 3).mean(axis=(1, 3))
    assert np.abs(image - blocks).max() <= 1


@pytest.mark.parametrize("region", [Region(0, 0, 640, 480), Region(100, 50, 320, 240), Region(-40, 60, 300, 300)])
def test_flat_positions_come_back(region: Region) -> None:
    truth = np.array([200.0, 170.0])
    picture = _dot_picture(640, 480, truth[None], 8)
    view = FlatFrame(picture, CanonicalCamera(96, 64)).crop(region)
    columns, rows = np.meshgrid(np.arange(96), np.arange(64))
    weight = view.image[..., 0].astype(float)
    found = [((weight * axis).sum() / weight.sum() - (side - 1) / 2) / 96 for axis, side in ((columns, 96), (rows, 64))]
    position = view.translation([*found, 0.0])
    expected = (truth - [319.5, 239.5]) / 640
    np.testing.assert_allclose(position, [*expected, 0], atol=1e-3)
    np.testing.assert_allclose(view.project([position]), truth, atol=0.6)
