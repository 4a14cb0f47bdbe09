"""Intrinsics: what is refused and why, half pixels, and the virtual cameras of crops."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from curio_train import camera
from curio_train.errors import CameraError
from curio_train.geometry import rotation_6d_from_matrix
from curio_train.metrics.poses import project
from curio_train.networks import crop_camera
from torch.nn.functional import grid_sample

LINEMOD = np.array([[572.4114, 0, 325.2611], [0, 573.57043, 242.04899], [0, 0, 1]])
SIZE = (640, 480)


def changed(row: int, column: int, value: float) -> np.ndarray:
    matrix = LINEMOD.copy()
    matrix[row, column] = value
    return matrix


@pytest.mark.parametrize(
    ("matrix", "text"),
    [
        (changed(0, 0, 0), "singular"),
        (changed(1, 1, -573), "singular or mirrored"),
        (changed(0, 2, np.nan), "not finite"),
        (changed(2, 2, 2), "last row has to be"),
        (changed(1, 0, 3), "entry below fx"),
        (LINEMOD.T, "transposed"),
        (changed(0, 2, 2000), "principal point (2000"),
        (np.array([[0.9, 0, 0.5], [0, 1.2, 0.5], [0, 0, 1]]), "must be in pixels"),
        (LINEMOD[:2], "shape [2, 3]"),
        ([[1, 2, "x"]], "expected 3x3"),
        (None, "expected [3, 3]"),
    ],
)
def test_refuses(matrix: object, text: str) -> None:
    with pytest.raises(CameraError) as caught:
        camera.check_matrix(matrix, *SIZE, where="frame.json, camera_matrix")
    assert text in str(caught.value)
    assert "frame.json, camera_matrix" in str(caught.value)


def test_refuses_the_matrix_of_a_larger_image() -> None:
    with pytest.raises(CameraError, match="another size"):
        camera.check_matrix(LINEMOD, 320, 240)


def test_accepts_linemod() -> None:
    assert np.array_equal(camera.check_matrix(LINEMOD.tolist(), *SIZE), LINEMOD)


def write(path: Path, content: object) -> Path:
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_loads_both_forms(tmp_path: Path) -> None:
    size = {"width": 640, "height": 480}
    bop = {"fx": 572.4114, "fy": 573.57043, "cx": 325.2611, "cy": 242.04899, "depth_scale": 1.0, **size}
    own = {"camera_matrix": LINEMOD.tolist(), "distortion": [0.1, 0, 0, 0, 0], **size}
    for content, distortion in ((bop, ()), (own, (0.1, 0, 0, 0, 0))):
        found = camera.load_intrinsics(write(tmp_path / "camera.json", content))
        assert np.array_equal(found.matrix, LINEMOD)
        assert (found.width, found.height, found.distortion) == (640, 480, distortion)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("", "not JSON"),
        ("[1, 2]", "unknown format with list"),
        ({"width": 640, "height": 480}, "expected camera_matrix"),
        ({"camera_matrix": LINEMOD.tolist(), "height": 480}, "no width and height"),
        ({"camera_matrix": LINEMOD.tolist(), "width": 640.5, "height": 480}, "width is 640.5"),
        (
            {"camera_matrix": LINEMOD.tolist(), "width": 640, "height": 480, "distortion": [1, 2]},
            "distortion has 2 values",
        ),
        ({"camera_matrix": LINEMOD.T.tolist(), "width": 640, "height": 480}, "transposed"),
    ],
)
def test_refuses_files(tmp_path: Path, content: object, text: str) -> None:
    path = write(tmp_path / "camera.json", content)
    with pytest.raises(CameraError) as caught:
        camera.load_intrinsics(path)
    assert text in str(caught.value)
    assert str(path) in str(caught.value)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match="cannot be read"):
        camera.load_intrinsics(tmp_path / "none.json")


def test_scaling_keeps_the_borders() -> None:
    # The image's borders, at -0.5 and width - 0.5, stay its borders: rays through them don't change.
    small = camera.scale_matrix(LINEMOD, SIZE, (128, 96))
    for before, after in (
        ((-0.5, -0.5), (-0.5, -0.5)),
        ((639.5, 479.5), (127.5, 95.5)),
        ((319.5, 239.5), (63.5, 47.5)),
    ):
        ray = np.linalg.inv(LINEMOD) @ [*before, 1]
        np.testing.assert_allclose(np.linalg.inv(small) @ [*after, 1], ray, atol=1e-12)


def test_gaze_puts_the_direction_in_the_centre() -> None:
    point = torch.tensor([[0.2, -0.15, 1.1]], dtype=torch.float64)
    gaze = crop_camera.crop_camera_at(point, torch.tensor([900.0], dtype=torch.float64), 128)
    seen = (gaze.rotation @ point[..., None])[..., 0]
    assert seen[0].tolist() == pytest.approx([0, 0, point.norm().item()], abs=1e-12)
    assert project(seen[0].numpy(), gaze.matrix[0].numpy()).tolist() == pytest.approx([63.5, 63.5], abs=1e-9)


def test_gaze_ahead_is_a_plain_crop() -> None:
    matrix = torch.tensor([[[100.0, 0, 31.5], [0, 100.0, 23.5], [0, 0, 1]]])
    frame = torch.arange(64 * 48, dtype=torch.float32).view(1, 1, 48, 64)
    gaze = crop_camera.crop_camera_at(torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([100.0]), 16)
    grid = crop_camera.sampling_grid(gaze, matrix, 16, 64, 48)
    crop = grid_sample(frame, grid, align_corners=False)
    torch.testing.assert_close(crop, frame[..., 16:32, 24:40], atol=0.05, rtol=0)


def test_grid_shows_points_where_the_crop_camera_sees_them_and_ignores_what_is_behind() -> None:
    matrix = torch.tensor(LINEMOD, dtype=torch.float32)[None]
    gaze = crop_camera.crop_camera_at(torch.tensor([[0.5, 0.2, 1.0]]), torch.tensor([300.0]), 32)
    grid = crop_camera.sampling_grid(gaze, matrix, 32, *SIZE)[0, 7, 21]
    frame = (grid + 1) * torch.tensor(SIZE) / 2 - 0.5
    ray = np.linalg.inv(LINEMOD) @ [*frame.tolist(), 1.0]
    seen = project(gaze.rotation[0].numpy() @ ray, gaze.matrix[0].numpy())
    assert seen.tolist() == pytest.approx([21, 7], abs=1e-2)
    sideways = crop_camera.crop_camera_at(torch.tensor([[1.0, 0.0, 0.01]]), torch.tensor([10.0]), 32)
    outside = crop_camera.sampling_grid(sideways, matrix, 32, *SIZE)[0, 16, 31]
    assert outside.abs().tolist() == pytest.approx([1 - 1 / SIZE[0], 1 - 1 / SIZE[1]])  # a corner of the frame


def test_gaze_has_gradients_straight_ahead() -> None:
    direction = torch.tensor([[0.0, 0.0, 1.0]], requires_grad=True)
    gaze = crop_camera.crop_camera_at(direction, torch.tensor([300.0]), 32)
    rotation_6d_from_matrix(gaze.rotation).sum().backward()
    assert torch.isfinite(direction.grad).all()
    assert direction.grad.abs().sum() > 0


def test_a_crop_rolled_by_a_quarter_is_the_crop_turned_clockwise() -> None:
    images = torch.rand(1, 3, 60, 80, generator=torch.Generator().manual_seed(0))
    matrix = torch.tensor([[90.0, 0.0, 39.5], [0.0, 90.0, 29.5], [0.0, 0.0, 1.0]])
    position_m, focal_px = torch.tensor([[[0.1, -0.05, 1.0]]]), torch.tensor([120.0])
    upright, crop_from_cam = crop_camera.cut_crops(images, matrix, position_m, focal_px, 16)
    quarter = crop_camera.about_axis(torch.tensor([[0.0, 1.0]]))
    rolled, rolled_from_cam = crop_camera.cut_crops(images, matrix, position_m, focal_px, 16, roll=quarter)
    torch.testing.assert_close(rolled, upright.rot90(-1, (2, 3)), atol=1e-4, rtol=0)
    torch.testing.assert_close(rolled_from_cam, quarter @ crop_from_cam)
