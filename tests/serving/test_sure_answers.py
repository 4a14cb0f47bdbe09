"""When answers of rigs and of followed objects are sure, and where they are in frames that were decoded smaller."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from curio_proto.v1 import detector_pb2 as messages
from curio_serve.api.rig_request import refuse_many_pixels
from curio_serve.errors import ArgumentError, CameraError
from curio_serve.imaging.camera import PinholeCamera, scaling
from curio_serve.models.detector import Detector
from curio_serve.models.model_folder import open_model
from curio_serve.models.repeated import AGREEMENT_POWER
from curio_serve.rigs.detect_views import RigView, detect_views
from curio_serve.tracking.stream import FollowingStream
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).parents[2]
CAMERA = PinholeCamera(np.array(json.loads((ROOT / "samples" / "camera.json").read_text())["camera_matrix"]))
SURE, UNSURE = messages.DETECTION_STATUS_SURE, messages.DETECTION_STATUS_UNSURE


@pytest.fixture(scope="module")
def ape() -> Detector:
    return Detector(open_model(ROOT / "models" / "ape"))


@pytest.fixture
def pixels() -> np.ndarray:
    return np.ascontiguousarray(cv2.imread(str(ROOT / "samples" / "03.jpg"))[..., ::-1])


def of_rig(detector: Detector, *views: RigView) -> messages.Detection:
    results = messages.DetectResponse().results
    detect_views(detector, views, results=results)
    return results[0].detections[0]


def followed(
    detector: Detector, frames: list[np.ndarray], camera: PinholeCamera, reduction: int = 1, step_s: float = 0.0
) -> list[list[messages.Detection]]:
    stream, results = FollowingStream(), messages.DetectResponse().results
    for number, frame in enumerate(frames):
        track = messages.Tracking(time_s=step_s * number) if step_s else messages.Tracking()
        stream.follow(track, [detector], frame, camera, min_confidence=0.0, reduction=reduction, results=results)
    return [list(result.detections) for result in results]


def test_one_view_that_others_contradict_is_not_sure(ape: Detector, pixels: np.ndarray) -> None:
    assert ape.detect(pixels, CAMERA)[0].detections[0].status == SURE
    aside = np.eye(4)
    aside[:3, :3] = Rotation.from_euler("z", 10, degrees=True).as_matrix()
    turn = CAMERA.matrix @ aside[:3, :3] @ np.linalg.inv(CAMERA.matrix)
    turned = cv2.warpPerspective(pixels, turn, (640, 480), borderMode=cv2.BORDER_REPLICATE)
    first, empty = RigView(pixels, CAMERA, np.eye(4)), RigView(np.full_like(pixels, 90), CAMERA, aside)
    agreeing = of_rig(ape, first, RigView(turned, CAMERA, aside))
    assert (len(agreeing.views), agreeing.status) == (2, SURE)
    alone = of_rig(ape, first, empty)
    assert (list(alone.views), alone.status) == ([0], UNSURE)
    assert alone.confidence > 0.5


def test_views_that_were_decoded_smaller_are_those_of_a_smaller_camera(ape: Detector, pixels: np.ndarray) -> None:
    large = PinholeCamera(scaling(2, 2) @ CAMERA.matrix)
    whole = of_rig(ape, *[RigView(pixels, CAMERA, np.eye(4))] * 2)
    reduced = of_rig(ape, *[RigView(pixels, large, np.eye(4), 2)] * 2)
    np.testing.assert_allclose(reduced.translation_m, whole.translation_m, atol=1e-4)
    np.testing.assert_allclose(reduced.rotation, whole.rotation, atol=1e-3)


def test_frames_that_were_decoded_smaller_are_followed(ape: Detector, pixels: np.ndarray) -> None:
    frames = [np.roll(pixels, -3 * number, axis=1) for number in range(6)]
    large = PinholeCamera(scaling(2, 2) @ CAMERA.matrix)
    for (one,), (other,) in zip(followed(ape, frames, CAMERA), followed(ape, frames, large, 2), strict=True):
        assert not other.track.predicted
        np.testing.assert_allclose(other.translation_m, one.translation_m, atol=1e-4)


def test_followed_objects_beyond_the_trained_range_say_so(ape: Detector) -> None:
    pixels = np.ascontiguousarray(cv2.imread(str(ROOT / "samples" / "01.jpg"))[..., ::-1])
    longer = PinholeCamera(np.diag([1.8, 1.8, 1]) @ CAMERA.matrix)  # the wrong K: everything is 1.8 times as far
    for camera, is_outside in ((CAMERA, False), (longer, True)):
        assert [one.outside_trained_range for (one,) in followed(ape, [pixels] * 3, camera)] == [is_outside] * 3


def test_a_predicted_pose_is_not_sure(ape: Detector, pixels: np.ndarray) -> None:
    hidden = np.full_like(pixels, 90)
    answers = followed(ape, [pixels] * 5 + [hidden], CAMERA)
    (seen,), (predicted,) = answers[-2:]
    assert (seen.track.predicted, seen.status) == (False, SURE)
    assert (predicted.track.predicted, predicted.status) == (True, UNSURE)


def test_a_pause_of_the_frames_ends_a_track(ape: Detector, pixels: np.ndarray) -> None:
    stream, results = FollowingStream(), messages.DetectResponse().results
    times_s = [0.0, 0.03, 0.07, 0.1, 100.0, 100.03]
    for time_s in times_s:
        track = messages.Tracking(time_s=1 + time_s)
        stream.follow(track, [ape], pixels, CAMERA, min_confidence=0.0, reduction=1, results=results)
    assert [result.detections[0].track.track_id for result in results] == [1, 1, 1, 1, 2, 2]
    slow = followed(ape, [pixels] * 4, CAMERA, step_s=5.0)
    assert [one.track.track_id for (one,) in slow] == [1] * 4, "slow frames are no pause"


def test_views_share_the_pixels_of_a_request(pixels: np.ndarray) -> None:
    views = [RigView(pixels, CAMERA, np.eye(4))] * 3
    refuse_many_pixels(views, 3 * 640 * 480)
    with pytest.raises(ArgumentError, match=r"views up to views\[2\] have 921600 pixels together; at most 900000"):
        refuse_many_pixels(views, 900_000)


def test_several_reads_are_no_surer_than_one(ape: Detector) -> None:
    """Backgrounds without the object: confidence of agreeing reads is higher, and the threshold is of single reads."""
    random = np.random.default_rng(0)
    (one,) = ape.model.spec.reliability.objects
    read_often, statuses = Detector(ape.model, 3), []
    for _ in range(12):
        coarse = random.integers(0, 255, (12, 16, 3), dtype=np.uint8)
        frame = cv2.resize(coarse, (640, 480), interpolation=cv2.INTER_CUBIC)
        (found,) = read_often.detect(frame, CAMERA)[0].detections
        share = found.confidence ** (1 / AGREEMENT_POWER)
        statuses.append((found.status == SURE, share >= one.min_confidence, found.confidence >= one.min_confidence))
    assert all(is_sure == by_share for is_sure, by_share, _ in statuses)
    assert any(by_confidence and not by_share for _, by_share, by_confidence in statuses), "the two differ in some"


def test_what_cannot_be_asked_of_a_detector_is_refused(ape: Detector, pixels: np.ndarray) -> None:
    for most in (0, -1):
        with pytest.raises(ArgumentError, match=f"max_detections is {most}"):
            ape.detect(pixels, CAMERA, max_detections=most)
    with pytest.raises(CameraError, match="the camera is a ndarray; expected a PinholeCamera"):
        ape.detect(pixels, CAMERA.matrix)  # type: ignore[arg-type]


def test_models_of_one_stream_give_no_number_twice(ape: Detector, pixels: np.ndarray) -> None:
    other = Detector(open_model(ROOT / "models" / "lmo").of(["ape"]))
    stream, results = FollowingStream(), messages.DetectResponse().results
    for restart in (False, False, True):
        track = messages.Tracking(restart=restart)
        stream.follow(track, [ape, other], pixels, CAMERA, min_confidence=0.0, reduction=1, results=results)
    numbers = [[one.track.track_id for one in result.detections] for result in results]
    assert numbers == [[1], [2]] * 3
