"""Drawing: what is drawn where, and that nothing off the frame or behind the camera breaks it."""

import itertools

import cv2
import numpy as np
import pytest
from curio_proto.v1.detector_pb2 import Detection, RegionResult
from curio_proto.v1.model_spec_pb2 import ModelSpec, ObjectModel
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.overlay import draw
from curio_serve.imaging.silhouette import Surface, silhouette
from scipy.spatial.transform import Rotation

CAMERA = PinholeCamera(np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]), (), (640, 480))
BOX_M = np.array(list(itertools.product((-0.05, 0.05), repeat=3)))


def spec(corners_m: np.ndarray = BOX_M) -> ModelSpec:
    return ModelSpec(objects=[ObjectModel(name="cube", diameter_m=0.17, box_corners_m=corners_m.ravel())])


def pose(
    rotation: np.ndarray, translation_m: tuple[float, float, float], corners_m: np.ndarray = BOX_M
) -> RegionResult:
    detection = Detection(
        object="cube",
        confidence=0.75,
        translation_m=translation_m,
        rotation=rotation.ravel(),
        box_px=CAMERA.project(corners_m @ rotation.T + translation_m).ravel(),
    )
    return RegionResult(detections=[detection])


TILTED = Rotation.from_euler("xyz", [25, 35, 5], degrees=True).as_matrix()


@pytest.mark.parametrize("shade", [0, 255, 128])
def test_strokes_stand_out_from_any_background(shade: int) -> None:
    frame = np.full((480, 640, 3), shade, np.uint8)
    drawn = draw(frame, [pose(TILTED, (0, 0, 0.6))], spec(), CAMERA)
    assert (frame == shade).all()
    distance = np.abs(drawn.astype(int) - shade).max(axis=2)
    assert (distance > 100).sum() > 1000  # strokes whose contrast the eye cannot miss


def test_near_edges_are_thicker_than_hidden_ones() -> None:
    """Of a cube seen face on, the near face's edges are seen and the far face's are hidden."""
    frame = np.full((480, 640, 3), 128, np.uint8)
    drawn = draw(frame, [pose(np.eye(3), (0, 0, 0.6))], spec(), CAMERA)
    touched = (drawn != frame).any(axis=2)
    row = touched[240 + 20]  # crosses no axis on the left side: near edge at x = 320 - 500 * 0.05 / 0.55
    near, far = round(320 - 25 / 0.55), round(320 - 25 / 0.65)
    assert row[near - 4 : near + 5].sum() > 2 * row[far - 3 : far + 4].sum() > 0


def test_the_order_of_the_corners_does_not_matter() -> None:
    frame = np.zeros((480, 640, 3), np.uint8)
    shuffled = BOX_M[[3, 7, 0, 5, 1, 6, 2, 4]]
    one = draw(frame, [pose(TILTED, (0, 0, 0.6))], spec(), CAMERA)
    other = draw(frame, [pose(TILTED, (0, 0, 0.6), shuffled)], spec(shuffled), CAMERA)
    assert (
        np.abs(one.astype(int) - other).max(axis=2).astype(bool).mean() < 0.001
    )  # where strokes cross, the last one wins


def test_axes_are_red_green_blue_from_the_origin() -> None:
    frame = np.full((480, 640, 3), 128, np.uint8)
    drawn = draw(frame, [pose(TILTED, (0, 0, 0.6))], spec(), CAMERA)
    halfway_m = np.array([0, 0, 0.6]) + 0.05 * TILTED.T  # row i: on axis i
    for channel, (u, v) in enumerate(CAMERA.project(halfway_m)):
        assert drawn[round(v), round(u)].argmax() == channel


@pytest.mark.parametrize("translation_m", [(0, 0, 0.02), (0, 0, -1), (0.3, 0, 0.051), (50, 0, 1), (0, 0, 1e4)])
def test_poses_off_the_frame_or_around_the_camera_do_no_harm(translation_m: tuple[float, float, float]) -> None:
    frame = np.full((480, 640, 3), 128, np.uint8)
    drawn = draw(frame, [pose(TILTED, translation_m)], spec(), CAMERA)
    assert drawn.shape == frame.shape


def test_flat_worlds_get_a_circle_in_the_box() -> None:
    frame = np.full((128, 128, 3), 60, np.uint8)
    corners = np.array([[x, y] for x in (40.0, 80.0) for y in (30.0, 70.0) for _ in range(2)])
    found = RegionResult(detections=[Detection(object="circle", confidence=1, box_px=corners.ravel())])
    drawn = draw(frame, [found], ModelSpec(objects=[ObjectModel(name="circle")]))
    ring = np.zeros((128, 128), np.uint8)
    cv2.circle(ring, (60, 50), 20, 255, 1)
    assert (drawn != frame).any(axis=2)[ring > 0].all()
    assert (drawn[50, 70] == 60).all()  # inside, beside the cross


def test_no_detection_leaves_the_frame_alone() -> None:
    frame = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    assert (draw(frame, [RegionResult()], spec(), CAMERA) == frame).all()


def test_an_object_the_spec_does_not_know_is_still_labelled() -> None:
    frame = np.zeros((480, 640, 3), np.uint8)
    found = pose(TILTED, (0, 0, 0.6))
    found.detections[0].object = "stranger"
    assert draw(frame, [found], spec(), CAMERA).any()


def test_labels_do_not_cover_each_other() -> None:
    """Two detections at one place: the surer one's label stays where it is alone, and the other one's is below it."""
    frame = np.full((480, 640, 3), 128, np.uint8)
    alone, both = pose(TILTED, (0, 0, 0.6)), pose(TILTED, (0, 0, 0.6))
    both.detections.add().CopyFrom(both.detections[0])
    both.detections[1].confidence = 0.25
    drawn = [draw(frame, [result], spec(), CAMERA) for result in (alone, both)]
    top = np.flatnonzero((drawn[0] != frame).any(axis=(1, 2)))[0]
    np.testing.assert_array_equal(drawn[1][top : top + 15], drawn[0][top : top + 15])
    assert not np.array_equal(drawn[1][top + 22 : top + 35], drawn[0][top + 22 : top + 35])


def test_a_slot_that_is_empty_to_two_digits_is_not_drawn() -> None:
    frame = np.zeros((480, 640, 3), np.uint8)
    found = pose(TILTED, (0, 0, 0.6))
    found.detections[0].confidence = 0.004
    assert not draw(frame, [found], spec(), CAMERA).any()
    found.detections[0].confidence = 0.006
    assert draw(frame, [found], spec(), CAMERA).any()


def _wedge() -> Surface:
    """Half a cube: its box looks the same after half a turn about z, the wedge does not."""
    caps, sides = [[0, 2, 4], [1, 3, 5]], [[0, 1, 4], [1, 5, 4], [0, 2, 3], [0, 3, 1], [2, 4, 5], [2, 5, 3]]
    return Surface(BOX_M[:6], np.array(caps + sides))


def test_a_contour_shows_half_a_turn_which_a_box_hides() -> None:
    frame = np.full((480, 640, 3), 128, np.uint8)
    half = np.diag([-1.0, -1.0, 1.0])
    poses = [pose(np.eye(3), (0, 0, 0.6)), pose(half, (0, 0, 0.6))]
    kind = spec()
    kind.objects[0].diameter_m = 0  # no axes
    boxes = [draw(frame, [one], kind, CAMERA) for one in poses]
    outlines = [draw(frame, [one], kind, CAMERA, {"cube": _wedge()}) for one in poses]
    differing = [(one != other).any(axis=2).sum() for one, other in (boxes, outlines)]
    assert differing[0] < 200 < 500 < differing[1]


def test_a_silhouette_covers_what_the_camera_sees_of_the_mesh() -> None:
    covered = silhouette(_wedge(), np.eye(3), np.array([0, 0, 0.6]), CAMERA, 640, 480)
    side_px = 500 * 0.1 / 0.55  # of its near face, a triangle of half a square
    assert covered.sum() == pytest.approx(side_px**2 / 2, rel=0.05)
    assert not silhouette(_wedge(), np.eye(3), np.array([0, 0, -1.0]), CAMERA, 640, 480).any()
