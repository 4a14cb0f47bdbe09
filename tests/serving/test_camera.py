"""Intrinsics: what is refused, how they turn with the pixels, and the files they come from."""

import json
import os
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from curio_serve.errors import CameraError
from curio_serve.imaging.camera import PinholeCamera, scaling
from curio_serve.imaging.camera_files import camera_of_images, read_camera_file

K = np.array([[572.4, 0, 325.3], [0, 573.6, 242.0], [0, 0, 1]])


def _changed(row: int, column: int, value: float) -> np.ndarray:
    matrix = K.copy()
    matrix[row, column] = value
    return matrix


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (np.zeros((3, 3)), "last row has to be"),
        (_changed(0, 0, 0), "singular or mirrored: fx = 0"),
        (_changed(1, 1, -573), "singular or mirrored"),
        (_changed(0, 0, np.nan), "not finite"),
        (_changed(0, 2, np.inf), "not finite"),
        (_changed(0, 1, 3), "skew of 3 px"),
        (K.T, "transposed"),
        (K[:2], r"shape \[2, 3\]"),
    ],
)
def test_impossible_matrices(matrix: np.ndarray, words: str) -> None:
    with pytest.raises(CameraError, match=words):
        PinholeCamera(matrix)


@pytest.mark.parametrize("distortion", [(0.1,), (0.1, 0, 0, float("nan")), (0.0,) * 14])
def test_impossible_distortion(distortion: tuple[float, ...]) -> None:
    with pytest.raises(CameraError, match="distortion has"):
        PinholeCamera(K, distortion)


@pytest.mark.parametrize("distortion", [(0, 0, 1e12, 0), (1e6, 0, 0, 0), (0, 0, 0, 0, 1e300), (0,) * 5 + (-9.0, 0, 0)])
def test_implausible_distortion(distortion: tuple[float, ...]) -> None:
    with pytest.raises(CameraError, match=r"moves pixels of a frame of 640x480 by up to .* px"):
        PinholeCamera(K, distortion).check_frame(640, 480)


@pytest.mark.parametrize("k1", [-0.5, -1.0, -2.0])
def test_a_distortion_that_folds_inside_the_frame(k1: float) -> None:
    """Beyond, the lens would see mirrored what it sees nearer to its middle."""
    camera = PinholeCamera(np.array([[572.0, 0, 320], [0, 572.0, 240], [0, 0, 1]]), (k1, 0, 0, 0))
    with pytest.raises(CameraError, match=r"turns back at \d\d% of the way to a corner of a frame of 640x480"):
        camera.check_frame(640, 480)


@pytest.mark.parametrize("distortion", [(-0.45, 0.3, 0.01, -0.01), (0.5, -2.6, 0.001, 0, 1.5, 0.4, -2.4, 1.4)])
def test_distortion_of_wide_lenses(distortion: tuple[float, ...]) -> None:
    PinholeCamera(np.array([[400.0, 0, 320], [0, 400.0, 240], [0, 0, 1]]), distortion).check_frame(640, 480)


@pytest.mark.parametrize(
    ("matrix", "size", "words"),
    [
        (K, (320, 240), r"principal point \(325.3, 242\) lies outside the frame of 320x240"),
        (np.diag([0.9, 1.2, 1.0]) + _changed(2, 2, 1) * 0, (640, 480), "fx = 0.9 px is implausible"),
        (_changed(1, 1, 573_600), (640, 480), "fy = 573600 px is implausible"),
    ],
)
def test_matrices_that_do_not_fit_the_frame(matrix: np.ndarray, size: tuple[int, int], words: str) -> None:
    with pytest.raises(CameraError, match=words):
        PinholeCamera(matrix).check_frame(*size)


def test_a_camera_of_another_size_is_named() -> None:
    with pytest.raises(CameraError, match="K belongs to frames of 640x480, this one has 1280x720"):
        PinholeCamera(K, size=(640, 480)).check_frame(1280, 720)


def test_a_frame_that_is_turned_by_a_quarter_is_named_as_such() -> None:
    with pytest.raises(CameraError, match=r"480x640; one of the two is rotated by 90 degrees.*EXIF.*as stored"):
        PinholeCamera(K, size=(640, 480)).check_frame(480, 640)


def test_scaling_keeps_the_frames_edges() -> None:
    corner = scaling(2, 3) @ [-0.5, -0.5, 1]
    np.testing.assert_allclose(corner, [-0.5, -0.5, 1])
    np.testing.assert_allclose(scaling(0.5, 0.25) @ [639.5, 479.5, 1], [319.5, 119.5, 1])


@pytest.mark.parametrize("turns", [0, 1, 2, 3, 4])
def test_a_camera_turns_with_its_pixels(turns: int) -> None:
    """A point projected by the turned camera lies where turning the pixels puts it."""
    width, height = 640, 480
    camera = PinholeCamera(K, (0.1, -0.05, 0.003, -0.002, 0.01), (width, height))
    points = np.random.default_rng(0).uniform([-0.3, -0.2, 1], [0.3, 0.2, 2], (20, 3))
    pixels, turned_points = camera.project(points), points.copy()
    size = (width, height)
    for _ in range(turns % 4):
        pixels = np.stack([size[1] - 1 - pixels[:, 1], pixels[:, 0]], axis=1)
        turned_points = np.stack([-turned_points[:, 1], turned_points[:, 0], turned_points[:, 2]], axis=1)
        size = size[::-1]
    turned = camera.turned(turns, width, height)
    assert turned.size == size
    np.testing.assert_allclose(turned.project(turned_points), pixels, atol=1e-9)


@pytest.mark.parametrize("distortion", [(), (0.1, -0.05, 0.003, -0.002, 0.01)])
def test_rays_and_pixels_are_inverse(distortion: tuple[float, ...]) -> None:
    camera = PinholeCamera(K, distortion)
    for pixel in ((0, 0), (100.5, 333), (639, 479)):
        ray = camera.ray(*pixel)
        assert np.linalg.norm(ray) == pytest.approx(1)
        np.testing.assert_allclose(camera.project(ray[None] * 3)[0], pixel, atol=0.05)


@pytest.mark.parametrize("distortion", [(), (0.1, -0.05, 0.002, -0.001, 0.01)])
def test_what_is_behind_has_no_pixel(distortion: tuple[float, ...]) -> None:
    camera, points = PinholeCamera(K, distortion), [[0, 0, -1.0], [0, 0, 1.0], [0, 0, 0]]
    nothing = [np.nan, np.nan]
    np.testing.assert_allclose(camera.project(np.array(points)), [nothing, K[:2, 2], nothing])
    np.testing.assert_allclose(camera.pixels(points), [*nothing, *K[:2, 2], *nothing])


@pytest.mark.parametrize("distortion", [(), (0.1, -0.05, 0.002, -0.001, 0.01)])
def test_pixels_of_plain_numbers_are_the_projected_ones(distortion: tuple[float, ...]) -> None:
    camera = PinholeCamera(K + np.array([[0, 1e-4, 0], [0, 0, 0], [0, 0, 0]]), distortion)
    points = np.random.default_rng(0).uniform((-0.3, -0.3, 0.5), (0.3, 0.3, 2), (8, 3))
    np.testing.assert_allclose(camera.pixels(points.tolist()), camera.project(points).ravel(), rtol=1e-12)


def test_our_json(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    content = {"camera_matrix": K.tolist(), "width": 640, "height": 480, "distortion": [0.1, 0, 0, 0, 0]}
    path.write_text(json.dumps(content))
    camera = read_camera_file(path).camera_for("any.png")
    np.testing.assert_array_equal(camera.matrix, K)
    assert camera.size == (640, 480)
    assert camera.distortion == (0.1, 0, 0, 0, 0)


@pytest.mark.parametrize("name", ["distortion_coefficients", "dist_coeffs", "dist"])
def test_distortion_counts_by_whichever_name(tmp_path: Path, name: str) -> None:
    path = tmp_path / "camera.json"
    content = {"camera_matrix": K.tolist(), "width": 640, "height": 480}
    path.write_text(json.dumps(content | {name: [0.1, 0, 0, 0, 0]}))
    assert read_camera_file(path).camera_for("any.png").distortion == (0.1, 0, 0, 0, 0)
    for wrong, text in (
        ({name: [0.1, 0, 0, 0], "distortion": [0.1, 0, 0, 0]}, "expected the distortion once"),
        ({"k1": 0.1, "k2": 0, "p1": 0}, "found k1; expected distortion as a list"),
        ({name: [0.1, 0, 0, 0], "distortion_model": "equidistant"}, "distortion_model is 'equidistant'"),
    ):
        path.write_text(json.dumps(content | wrong))
        with pytest.raises(CameraError, match=text):
            read_camera_file(path)


def test_bop_camera(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text(
        '{"cx": 325.3, "cy": 242.0, "depth_scale": 1.0, "fx": 572.4, "fy": 573.6, "height": 480, "width": 640}'
    )
    camera = read_camera_file(path).camera_for("any.png")
    np.testing.assert_array_equal(camera.matrix, K)
    assert camera.size == (640, 480)


def test_distortion_beside_focal_lengths_counts(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    values = {"fx": 572.4, "fy": 573.6, "cx": 325.3, "cy": 242.0, "width": 640, "height": 480}
    path.write_text(json.dumps({**values, "distortion": [0.1, 0, 0, 0]}))
    assert read_camera_file(path).camera_for("any.png").distortion == (0.1, 0, 0, 0)
    path.write_text(json.dumps({**values, "distortion": [0, 0, 1e12, 0]}))
    with pytest.raises(CameraError, match="moves pixels"):
        read_camera_file(path)


@pytest.mark.parametrize("name", ["dist_coeff", "distCoeffs", "D", "distortion_coeffs", "Distortion_Coefficients"])
@pytest.mark.parametrize("suffix", ["json", "yml"])
def test_a_lens_under_a_name_that_is_not_read_is_refused(tmp_path: Path, suffix: str, name: str) -> None:
    path = tmp_path / f"camera.{suffix}"
    if suffix == "json":
        path.write_text(json.dumps({"camera_matrix": K.tolist(), name: [0.1, 0, 0, 0, 0]}))
    else:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        storage.write("camera_matrix", K)
        storage.write(name, np.array([0.1, 0, 0, 0, 0]))
        storage.release()
    with pytest.raises(CameraError, match=f"found {name}, which is not read"):
        read_camera_file(path)


def test_fisheye_and_sizes_by_their_other_names(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({"camera_matrix": K.tolist(), "image_width": 640, "image_height": 480}))
    assert read_camera_file(path).camera_for("a.png").size == (640, 480)
    storage = cv2.FileStorage(str(tmp_path / "camera.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("fisheye_model", 1)
    storage.write("camera_matrix", K)
    storage.release()
    with pytest.raises(CameraError, match="fisheye_model is set"):
        read_camera_file(tmp_path / "camera.yml")


def test_bop_scene_camera_is_of_its_own_scene(tmp_path: Path) -> None:
    for scene in ("000001", "000002"):
        (tmp_path / scene / "rgb").mkdir(parents=True)
        (tmp_path / scene / "scene_camera.json").write_text(json.dumps({"0": {"cam_K": K.ravel().tolist()}}))
    cameras = read_camera_file(tmp_path / "000001" / "scene_camera.json")
    assert cameras.camera_for(tmp_path / "000001" / "rgb" / "000000.png").matrix.tolist() == K.tolist()
    with pytest.raises(CameraError, match=r"is of another scene than .*its cameras are in .*000002"):
        cameras.camera_for(tmp_path / "000002" / "rgb" / "000000.png")


def test_bop_scene_camera_is_looked_up_by_the_images_number(tmp_path: Path) -> None:
    path = tmp_path / "scene_camera.json"
    entries = {str(n): {"cam_K": [500.0 + n, 0, 320, 0, 500, 240, 0, 0, 1], "depth_scale": 1.0} for n in (0, 7, 12)}
    path.write_text(json.dumps(entries))
    file = read_camera_file(path)
    assert file.camera_for("lm/test/000001/rgb/000007.png").matrix[0, 0] == 507
    assert file.camera_for(Path("000012.jpg")).matrix[0, 0] == 512
    with pytest.raises(CameraError, match=r"no K for image 8 .*it has 3 from 0 to 12"):
        file.camera_for("000008.png")
    with pytest.raises(CameraError, match="has no number"):
        file.camera_for("frame.png")


def test_opencv_yaml(tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", np.array([[0.1, -0.2, 0.001, 0.002, 0.05]]))
    storage.release()
    camera = read_camera_file(path).camera_for("x.png")
    np.testing.assert_array_equal(camera.matrix, K)
    assert camera.size == (640, 480)
    assert camera.distortion == pytest.approx((0.1, -0.2, 0.001, 0.002, 0.05))


@pytest.mark.parametrize("head", ["---\n", "\ufeff", "\ufeff---\n"])
def test_yaml_with_a_head_of_its_own(tmp_path: Path, head: str) -> None:
    matrix = "{rows: 3, cols: 3, data: [500, 0, 320, 0, 510, 240, 0, 0, 1]}"
    path = tmp_path / "c.yaml"
    path.write_text(f"{head}image_width: 640\nimage_height: 480\ncamera_matrix: {matrix}\n", encoding="utf-8")
    camera = read_camera_file(path).camera_for("x.png")
    assert camera.matrix[1, 1] == 510
    assert camera.size == (640, 480)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("c.json", "{", "is not JSON"),
        ("c.json", "[1, 2]", "unknown format with list"),
        ("c.json", '{"K": [1]}', r"K has shape \[1\]"),
        ("c.json", '{"camera_matrix": [[1, 2], [3]]}', "cannot be understood"),
        ("c.json", '{"camera_matrix": "abc"}', "cannot be understood"),
        ("c.json", '{"camera_matrix": [[500,0,320],[0,500,240],[0,0,0]]}', "last row"),
        (
            "c.yaml",
            "camera_matrix: {rows: 3, cols: 3, data: [500, 0, 320, 0, 500, 240, 0, 0, 1]}\n"
            "distortion_model: equidistant\n"
            "distortion_coefficients: {rows: 1, cols: 4, data: [0.1, 0.01, 0, 0]}\n",
            "distortion_model is 'equidistant'",
        ),
        ("c.yaml", "nothing: here", "cannot be understood|no matrix camera_matrix"),
        ("c.yaml", "%YAML:1.0\n---\nwidth: 640\n", "no matrix camera_matrix"),
    ],
)
def test_bad_files_are_named(tmp_path: Path, name: str, text: str, words: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(CameraError, match=words) as caught:
        read_camera_file(path)
    assert str(path) in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match=r"none\.json cannot be read"):
        read_camera_file(tmp_path / "none.json")


def test_files_that_are_none_are_named(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.json")
    (tmp_path / "nested.json").write_text("[" * 100_000)
    with open(tmp_path / "sparse.json", "wb") as sparse:
        sparse.truncate(20 << 30)
    for name, words in (
        ("pipe", "not a regular file"),
        ("nested", "cannot be understood"),
        ("sparse", "at most 67108864"),
    ):
        with pytest.raises(CameraError, match=words):
            read_camera_file(tmp_path / f"{name}.json")


@pytest.mark.parametrize(
    ("topic", "is_rectified"),
    [
        ("/camera/image_raw", False),
        ("/camera/image_raw/compressed", False),
        ("/rect_camera/image", False),
        ("/camera/direct", False),
        ("/camera/image_rect", True),
        ("/camera/image_rect_color/compressed", True),
    ],
)
def test_rectified_images_of_a_topic_have_p_and_raw_ones_k_and_d(topic: str, is_rectified: bool) -> None:
    """P of a stereo pair's second camera, whose fourth column is no part of its K."""
    k, p = [600.0, 0, 320, 0, 601, 240, 0, 0, 1], [500.0, 0, 310, -60, 0, 500, 245, 0, 0, 0, 1, 0]
    lens = [0.1, 0.01, 0.0, 0.0, 0.0]
    info = SimpleNamespace(width=640, height=480, k=k, d=lens, p=p, distortion_model="plumb_bob")
    camera = camera_of_images(info, topic)
    assert camera.size == (640, 480)
    expected = [500.0, 0, 310, 0, 500, 245, 0, 0, 1] if is_rectified else k
    assert camera.matrix.ravel().tolist() == expected
    assert list(camera.distortion) == ([] if is_rectified else lens)
    with pytest.raises(CameraError):
        camera_of_images(SimpleNamespace(**vars(info) | {"k": [0.0] * 9, "p": [0.0] * 12}), topic)
