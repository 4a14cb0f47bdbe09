"""Following in streams: the filter's figures, tracks through a gap, and streams that change or go back in time."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from curio_proto.v1 import detector_pb2 as messages
from curio_proto.v1.model_spec_pb2 import ObjectModel, Symmetry
from curio_serve.client import PoseClient
from curio_serve.client.request import detect_request
from curio_serve.errors import ArgumentError, ModelError
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.models.detector import Detector
from curio_serve.models.model_folder import open_model
from curio_serve.models.object_frames import symmetry_rotations
from curio_serve.models.stages import crop_stage, outline_stage
from curio_serve.models.stages.crop_stage import CROP_STAGE_KEY, CropStageNote
from curio_serve.models.stages.outline_stage import OUTLINE_STAGE_KEY, OutlineStageNote
from curio_serve.tracking.pose_filter import PoseFilter
from curio_serve.tracking.stream import FollowingStream
from curio_serve.tracking.tracks import Measurement, Track, assign, without_doubles
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).parents[2]
K = np.array([[300.0, 0, 160.0], [0, 301.0, 119.0], [0, 0, 1]])
NOISE_M, FRAME_S = 2e-3, 1 / 30
BALL = ObjectModel(name="ball", diameter_m=0.1)
Spot = Callable[..., np.ndarray]


def _frame(spot_image: Spot, u: float, sigma: float = 12) -> np.ndarray:
    return spot_image(320, 240, u, 120, sigma, sigma, (255, 128, 0))


def _request(pixels: np.ndarray, camera: np.ndarray = K, **track: object) -> messages.DetectRequest:
    tracking = messages.Tracking(**track)  # type: ignore[arg-type]
    return detect_request("pinhole", pixels, camera, min_confidence=0.3, track=tracking)


@pytest.fixture
def client(server) -> Iterator[PoseClient]:
    with PoseClient(server.address) as found:
        yield found


def _filtered(positions: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Noisy measurements of positions, and what the filter makes of them."""
    measured = positions + random.normal(0, NOISE_M, positions.shape)
    covariance = np.eye(3) * NOISE_M**2
    pose = PoseFilter(measured[0], np.eye(3), covariance, 0.01)
    found = [pose.translation_m.copy()]
    for position in measured[1:]:
        pose.predict(FRAME_S)
        pose.update(position, covariance)
        found.append(pose.translation_m.copy())
    return measured, np.array(found)


def test_a_filtered_pose_at_rest_trembles_a_quarter_as_much() -> None:
    measured, found = _filtered(np.tile([0.1, 0.0, 0.8], (200, 1)), np.random.default_rng(0))
    jitter = [np.linalg.norm(np.diff(values[30:], axis=0), axis=1).mean() for values in (measured, found)]
    assert jitter[1] < jitter[0] / 4


@pytest.mark.parametrize("start", [0, 60])
def test_a_filtered_pose_is_not_a_frame_late_at_half_a_metre_a_second(start: int) -> None:
    """Both for an object that moves all the time and for one that stood still until then."""
    x = np.maximum(np.arange(150) - start, 0) * 0.5 * FRAME_S
    truth = np.stack([x, np.zeros(150), np.full(150, 0.8)], axis=1)
    _, found = _filtered(truth, np.random.default_rng(1))
    late_m = (truth - found)[start + 5 :, 0]
    assert np.abs(late_m).mean() < 0.5 * FRAME_S
    assert late_m.max() < 0.5 * FRAME_S + 3 * NOISE_M


def test_rotations_are_filtered_on_the_shortest_way() -> None:
    turns = Rotation.from_rotvec(np.outer(np.arange(60) * FRAME_S, [0.0, 0.0, 3.0])).as_matrix()
    pose = PoseFilter(np.zeros(3), turns[0], np.eye(3) * 1e-6, 1e-4)
    for rotation in turns[1:]:
        pose.predict(FRAME_S)
        pose.update_rotation(rotation, 1e-4)
    assert np.trace(pose.rotation.T @ turns[-1]) > 1 + 2 * np.cos(0.02)
    np.testing.assert_allclose(pose.turn_rad_s, [0, 0, 3.0], atol=0.1)


def _measured(x: float, rotation: np.ndarray | None = None) -> Measurement:
    turned = np.eye(3) if rotation is None else rotation
    return Measurement.of_whole_frame(BALL, np.array([x, 0.0, 0.8]), turned, 0.9)


def test_two_equal_objects_keep_their_numbers() -> None:
    tracks = [Track.begin(number, BALL, _measured(x), 0.0) for number, x in ((1, -0.1), (2, 0.1))]
    for track in tracks:
        track.predict(FRAME_S)
    assert assign(tracks, [_measured(0.11), _measured(-0.09)], FRAME_S, alone=False) == {0: 1, 1: 0}
    assert assign(tracks, [_measured(2.0)], FRAME_S, alone=False) == {}
    assert assign(tracks[:1], [_measured(2.0)], FRAME_S, alone=True) == {0: 0}
    twice = [*tracks, Track.begin(3, BALL, _measured(0.101), FRAME_S)]
    assert [track.number for track in without_doubles(twice[1:])] == [3]  # the others are not seen in this frame


def test_a_symmetric_pose_is_no_movement() -> None:
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    kind = ObjectModel(name="ball", diameter_m=0.1, symmetries=[Symmetry(transform=half_turn.ravel())])
    assert len(symmetry_rotations(kind)) == 2
    assert len(symmetry_rotations(ObjectModel(symmetries=[Symmetry(axis=[0, 0, 1])]))) == 72
    track = Track.begin(1, kind, _measured(0.0), 0.0)
    for number in range(1, 4):
        track.predict(FRAME_S)
        track.update(_measured(0.0, half_turn[:3, :3]), number * FRAME_S)
    np.testing.assert_allclose(track.filter.rotation, np.eye(3), atol=1e-6)


def test_a_ball_does_not_turn_whatever_is_read() -> None:
    axes = [Symmetry(axis=axis, offset_m=[0.0] * 3) for axis in ([0.0, 0.6, 0.8], [1.0, 0.0, 0.0])]
    kind = ObjectModel(name="ball", diameter_m=0.1, symmetries=axes)
    assert len(symmetry_rotations(kind)) == 1, "and not all products of turns about both axes"
    turns = [Rotation.from_euler("xyz", angles, degrees=True).as_matrix() for angles in ((90, 0, 0), (10, 70, -40))]
    first, *others = (
        Measurement.of_whole_frame(kind, np.array([0.0, 0.0, 0.8]), turn, 0.9) for turn in (np.eye(3), *turns)
    )
    track = Track.begin(1, kind, first, 0.0)
    for number, measured in enumerate(others, start=1):
        track.predict(FRAME_S)
        track.update(measured, number * FRAME_S)
    np.testing.assert_allclose(track.filter.rotation, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(track.filter.turn_rad_s, 0, atol=1e-6)


def test_a_rotation_that_jumps_once_is_not_believed_and_one_that_stays_is() -> None:
    flipped = Rotation.from_euler("x", 120, degrees=True).as_matrix()
    track = Track.begin(1, BALL, _measured(0.0), 0.0)
    seen = [flipped, np.eye(3), *[flipped] * 5]
    for number, rotation in enumerate(seen, start=1):
        track.predict(FRAME_S)
        track.update(_measured(0.0, rotation), number * FRAME_S)
        if number < len(seen):
            np.testing.assert_allclose(track.filter.rotation, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(track.filter.rotation, flipped, atol=1e-6)


def test_an_object_keeps_its_track_through_a_gap_and_a_stream_forgets_at_its_end(
    client: PoseClient, spot_image: Spot
) -> None:
    black = np.zeros((240, 320, 3), np.uint8)
    frames = [*[_frame(spot_image, 100 + 2 * n) for n in range(10)], *[black] * 8, _frame(spot_image, 136)]
    answers = list(client.detect_stream(map(_request, frames), timeout_s=60))
    tracks = [answer.results[0].detections[0].track for answer in answers]
    assert {track.track_id for track in tracks} == {1}
    assert [track.predicted for track in tracks] == [False] * 10 + [True] * 8 + [False]
    assert tracks[9].age_s == pytest.approx(9 * FRAME_S)
    assert tracks[17].unseen_s == pytest.approx(8 * FRAME_S)
    for answer in answers[5:10]:
        (found,) = answer.results[0].detections
        np.testing.assert_allclose(found.track.translation_m, found.translation_m, atol=0.02)
        assert found.track.velocity_m_s[0] > 0
    gone = [_request(frame, keep_s=0.1) for frame in (frames[0], *[black] * 5)]
    counts = [len(answer.results[0].detections) for answer in client.detect_stream(gone, timeout_s=60)]
    assert counts == [1, 1, 1, 1, 0, 0]


def test_a_stream_goes_on_after_frames_that_do_not_belong_to_it(client: PoseClient, spot_image: Spot) -> None:
    pixels, other = _frame(spot_image, 100), K * [[1.1], [1], [1]]
    requests = [
        _request(pixels, time_s=1.0),
        _request(pixels, time_s=0.9),
        _request(pixels, time_s=1.0),
        _request(np.ascontiguousarray(pixels[:200]), time_s=1.1),
        _request(pixels, other, time_s=1.1),
        _request(pixels, time_s=float("nan")),
        _request(pixels, time_s=1.1, num_objects=0),
        _request(pixels, time_s=1.1, keep_s=-1.0),
        detect_request("flat", pixels, track=messages.Tracking(time_s=1.1)),
        detect_request("pinhole", pixels, K, regions=[(0, 0, 9, 9)], track=messages.Tracking(time_s=1.1)),
        _request(pixels, time_s=1.1),
        _request(pixels, other, time_s=0.5, restart=True),
    ]
    *_, last, anew = answers = list(client.detect_stream(requests, timeout_s=60))
    assert [answer.error.reason for answer in answers[1:-2]] == [
        *["ArgumentError"] * 2,
        *["CameraError"] * 2,
        *["ArgumentError"] * 5,
    ]
    assert "0.900000, 0.1 s before that of the frame before" in answers[1].error.message
    assert "320x200 pixels, those before it 320x240" in answers[3].error.message
    assert last.results[0].detections[0].track.age_s == pytest.approx(0.1)
    assert anew.results[0].detections[0].track.age_s == 0
    with pytest.raises(ArgumentError, match="followed in DetectStream"):
        client._call(client._stub.Detect, requests[0], None)


@pytest.mark.parametrize("scale", [1, 2])
def test_a_shipped_model_reads_crops_alone_as_well_as_whole_frames(scale: int) -> None:
    model = open_model(ROOT / "models" / "ape")
    assert model.crop_stage is not None
    camera = json.loads((ROOT / "samples" / "camera.json").read_text())
    truths = json.loads((ROOT / "samples" / "poses.json").read_text())
    pinhole = PinholeCamera(np.array(camera["camera_matrix"]))
    errors = []
    for file, poses in truths.items():
        pixels = np.ascontiguousarray(cv2.imread(str(ROOT / "samples" / file))[..., ::-1])
        near = next(np.array(pose["translation_m"]) for pose in poses if pose["object"] == "ape")
        (found,) = Detector(model).detect(pixels, pinhole)
        larger = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        matrix = np.array([[scale, 0, (scale - 1) / 2], [0, scale, (scale - 1) / 2], [0, 0, 1]]) @ pinhole.matrix
        read = model.crop_stage.read(larger, PinholeCamera(matrix), near + np.array([0.02, -0.01, 0.03]), 572.4)
        errors.append(np.linalg.norm(read.translation_m - found.detections[0].translation_m))
        assert abs(read.confidence - found.detections[0].confidence) < 0.3
        assert 0 < np.trace(read.position_covariance_m2) < 0.1**2
    assert max(errors) < 0.02


def test_following_with_a_shipped_model_keeps_a_still_object() -> None:
    detector = Detector(open_model(ROOT / "models" / "ape"))
    camera = PinholeCamera(np.array(json.loads((ROOT / "samples" / "camera.json").read_text())["camera_matrix"]))
    pixels = np.ascontiguousarray(cv2.imread(str(ROOT / "samples" / "01.jpg"))[..., ::-1])
    stream, results = FollowingStream(), messages.DetectResponse().results
    black = np.zeros_like(pixels)
    for frame in (*[pixels] * 5, black, black, pixels):
        stream.follow(messages.Tracking(), [detector], frame, camera, min_confidence=0.0, reduction=1, results=results)
    tracks = [result.detections[0].track for result in results]
    assert {track.track_id for track in tracks} == {1}
    assert [track.predicted for track in tracks] == [False] * 5 + [True] * 2 + [False]


@pytest.mark.parametrize("moved_px", [(45, 30), (-40, 45), (0, -50)])
def test_an_object_that_moved_while_it_was_hidden_is_found_beside_its_last_place(moved_px: tuple[int, int]) -> None:
    detector = Detector(open_model(ROOT / "models" / "ape"))
    camera = PinholeCamera(np.array(json.loads((ROOT / "samples" / "camera.json").read_text())["camera_matrix"]))
    pixels = np.ascontiguousarray(cv2.imread(str(ROOT / "samples" / "01.jpg"))[..., ::-1])
    moved = np.roll(pixels, moved_px[::-1], axis=(0, 1))
    num_runs: list[int] = []
    stream, results = FollowingStream(), messages.DetectResponse().results
    for frame in (*[pixels] * 3, *[np.zeros_like(pixels)] * 3, *[moved] * 4):
        num_runs.append(0)

        def count() -> None:
            num_runs[-1] += 1

        stream.follow(
            messages.Tracking(),
            [detector],
            frame,
            camera,
            min_confidence=0.0,
            reduction=1,
            results=results,
            before_run=count,
        )
    last = results[-1].detections[0]
    assert (last.track.track_id, last.track.predicted) == (1, False)
    slope = np.array(last.translation_m[:2]) / last.translation_m[2]
    before = results[2].detections[0].translation_m
    gap_px = 572.4 * (slope - np.array(before[:2]) / before[2])
    assert gap_px == pytest.approx(moved_px, abs=8)
    assert 9 in {runs - 1 for runs in num_runs[6:]}, "the crops found it, without a look at the whole frame"


@pytest.mark.parametrize(
    "change", [{"side_px": -1}, {"tensors": {}}, {"presence": [1.0]}, {"fill": "wide"}, {"unknown": 1}]
)
def test_a_note_that_cannot_be_is_refused(change: dict[str, object]) -> None:
    names = (crop_stage.INPUT, *crop_stage.OUTPUTS)
    note: dict[str, object] = {"tensors": {name: name for name in names}, "side_px": 64, "fill": 0.6}
    note |= {"diameter_m": 0.1, "near_m": 0.5, "pose_correct": [1.0, 0.0], "presence": [1.0, 1.0, 0.0]}
    assert CropStageNote.parse(json.dumps(note), "file").side_px == 64
    with pytest.raises(ModelError, match=CROP_STAGE_KEY):
        CropStageNote.parse(json.dumps(note | change), "file")


@pytest.mark.parametrize(
    "change", [{"side_px": 0}, {"tensors": {}}, {"tensors": [{}]}, {"fill": "wide"}, {"near_m": 1}]
)
def test_a_note_of_outlines_that_cannot_be_is_refused(change: dict[str, object]) -> None:
    names = (*outline_stage.INPUTS, *outline_stage.OUTPUTS)
    note: dict[str, object] = {"tensors": {name: name for name in names}, "side_px": 128, "fill": 0.6}
    note |= {"diameter_m": 0.1}
    assert OutlineStageNote.parse(json.dumps(note), "file").side_px == 128
    with pytest.raises(ModelError, match=OUTLINE_STAGE_KEY):
        OutlineStageNote.parse(json.dumps(note | change), "file")
