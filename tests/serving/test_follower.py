"""What is followed of the shipped model of an ape: when whole frames are looked at, and what a frame changes."""

import json
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import pytest
from curio_proto.v1 import detector_pb2 as messages
from curio_proto.v1.model_spec_pb2 import CanonicalCamera, Field, ModelSpec, ObjectModel
from curio_serve.client import PoseClient
from curio_serve.client.request import detect_request
from curio_serve.errors import CameraMissing, InternalError
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.models.detector import Detector
from curio_serve.models.model import from_bytes
from curio_serve.models.model_folder import open_model
from curio_serve.models.spec import SPEC_KEY
from curio_serve.tracking.stream import FollowingStream
from google.protobuf import json_format
from onnx import TensorProto, helper, numpy_helper

ROOT = Path(__file__).parents[2]


def _photograph(name: str) -> tuple[Detector, PinholeCamera, np.ndarray]:
    camera = PinholeCamera(np.array(json.loads((ROOT / "samples" / "camera.json").read_text())["camera_matrix"]))
    pixels = np.ascontiguousarray(cv2.imread(str(ROOT / "samples" / name))[..., ::-1])
    return Detector(open_model(ROOT / "models" / "ape")), camera, pixels


@pytest.mark.parametrize(("num_objects", "look_s", "found"), [(1, 2.0, 1), (2, 0.5, 2)])
def test_the_whole_frame_is_looked_at_for_another_object_and_to_make_sure(
    num_objects: int, look_s: float, found: int
) -> None:
    """The second ape is a copy of the first one's surroundings, 220 pixels to the left."""
    detector, camera, pixels = _photograph("03.jpg")
    pixels[223:363, 126:266] = pixels[223:363, 346:486]
    runs_at: list[int] = []
    stream, results = FollowingStream(), messages.DetectResponse().results
    for _ in range(round(30 * look_s) + 2):  # 30 frames a second
        stream.follow(
            messages.Tracking(num_objects=num_objects),
            [detector],
            pixels,
            camera,
            min_confidence=0.0,
            reduction=1,
            results=results,
            before_run=lambda: runs_at.append(len(results)),
        )
    # One run reads the crops of the object that is followed; one more looks at the whole frame.
    second = next(number for number in range(len(results)) if runs_at.count(number) == 2)
    assert second == pytest.approx(30 * look_s, abs=1)
    assert len(results[-1].detections) == found
    apart_m = np.ptp([detection.translation_m[0] for detection in results[-1].detections])
    assert apart_m == pytest.approx(0.3 * (found - 1), abs=0.03)


def test_how_long_a_hidden_object_is_answered_does_not_change_the_filter() -> None:
    detector, camera, pixels = _photograph("03.jpg")
    found = []
    for keep_s in (1.5, 0.0):
        stream, results = FollowingStream(), messages.DetectResponse().results
        for number in range(8):
            frame = np.roll(pixels, -3 * number, axis=1)
            track = messages.Tracking(keep_s=keep_s)
            stream.follow(track, [detector], frame, camera, min_confidence=0.0, reduction=1, results=results)
        found.append([list(result.detections[0].track.velocity_m_s) for result in results])
    np.testing.assert_allclose(found[0], found[1])
    assert abs(found[0][-1][0]) > 0.05


def test_a_frame_on_which_a_network_fails_changes_nothing() -> None:
    """It comes a tenth of a second late; the next one is in time, and the track goes on as it would have without."""
    detector, camera, pixels = _photograph("03.jpg")

    def fail() -> None:
        raise InternalError("the network failed")

    found = []
    for failing in (False, True):
        stream, results = FollowingStream(), messages.DetectResponse().results
        for number in range(6):
            frame = np.roll(pixels, -3 * number, axis=1)
            if failing and number == 4:
                late = messages.Tracking(time_s=0.1 * number + 0.09)
                with pytest.raises(InternalError):
                    stream.follow(
                        late,
                        [detector],
                        frame,
                        camera,
                        min_confidence=0.0,
                        reduction=1,
                        results=messages.DetectResponse().results,
                        before_run=fail,
                    )
            track = messages.Tracking(time_s=0.1 * number)
            stream.follow(track, [detector], frame, camera, min_confidence=0.0, reduction=1, results=results)
        found.append([detection.track for result in results for detection in result.detections])
    assert len(found[0]) == 6
    assert [track.track_id for track in found[0]] == [track.track_id for track in found[1]]
    for with_it, without in zip(*found, strict=True):
        np.testing.assert_allclose(with_it.velocity_m_s, without.velocity_m_s, atol=1e-9)


def test_a_refused_frame_changes_nothing_not_even_with_restart() -> None:
    detector, camera, pixels = _photograph("03.jpg")
    stream, results = FollowingStream(), messages.DetectResponse().results

    def follow(known: PinholeCamera | None, time_s: float, restart: bool = False) -> None:
        track = messages.Tracking(time_s=time_s, restart=restart)
        stream.follow(track, [detector], pixels, known, min_confidence=0.0, reduction=1, results=results)

    with pytest.raises(CameraMissing):
        follow(None, 1.0)
    follow(camera, 0.5)
    with pytest.raises(CameraMissing):
        follow(None, 0.6, restart=True)
    follow(camera, 0.6)
    assert [result.detections[0].track.age_s for result in results] == pytest.approx([0, 0.1])


def test_what_is_found_again_beside_its_place_puts_off_no_look() -> None:
    """The camera jerks every twelfth frame; the second ape is found all the same."""
    detector, camera, pixels = _photograph("03.jpg")
    pixels[223:363, 126:266] = pixels[223:363, 346:486]
    jerked = np.roll(pixels, (25, 35), axis=(0, 1))
    stream, results = FollowingStream(), messages.DetectResponse().results
    for number in range(40):
        frame = jerked if number // 12 % 2 else pixels
        track = messages.Tracking(num_objects=2)
        stream.follow(track, [detector], frame, camera, min_confidence=0.0, reduction=1, results=results)
    assert max(len(result.detections) for result in results) == 2


def test_fewer_objects_keep_those_that_are_seen() -> None:
    detector, camera, pixels = _photograph("03.jpg")
    both = pixels.copy()
    both[223:363, 126:266] = pixels[223:363, 346:486]
    right_hidden = both.copy()
    right_hidden[:, 300:] = 0
    stream, results = FollowingStream(), messages.DetectResponse().results
    for frame, num_objects in [*[(both, 2)] * 20, (right_hidden, 2), (right_hidden, 1)]:
        track = messages.Tracking(num_objects=num_objects)
        stream.follow(track, [detector], frame, camera, min_confidence=0.0, reduction=1, results=results)
    assert [detection.track.predicted for detection in results[20].detections] == [False, True]
    (left,) = results[21].detections
    assert not left.track.predicted
    assert left.translation_m[0] < 0


def test_a_frame_that_one_of_two_models_cannot_take_moves_neither(tmp_path: Path) -> None:
    """The first has a default camera, the second needs that of the frame."""
    needs, camera, pixels = _photograph("03.jpg")
    model = onnx.load(ROOT / "models" / "ape" / "2" / "model.onnx")
    (entry,) = [entry for entry in model.metadata_props if entry.key == SPEC_KEY]
    spec = json_format.Parse(entry.value, ModelSpec())
    spec.name, spec.camera.is_default = "default", True
    entry.value = json_format.MessageToJson(spec)
    has_default = Detector(from_bytes(model.SerializeToString(), "default"))
    stream, results = FollowingStream(), messages.DetectResponse().results

    def follow(known: PinholeCamera | None, time_s: float) -> None:
        track, both = messages.Tracking(time_s=time_s), [has_default, needs]
        stream.follow(track, both, pixels, known, min_confidence=0.0, reduction=1, results=results)

    with pytest.raises(CameraMissing):
        follow(None, 5.0)
    assert not results
    follow(camera, 1.0)
    follow(camera, 1.1)
    assert [result.detections[0].track.age_s for result in results] == pytest.approx([0, 0, 0.1, 0.1])


def test_a_clearly_surer_object_takes_the_place_of_one_that_is_seen() -> None:
    """Two are followed, one of them blurred; a third that is not is found when the whole frame is looked at again."""
    detector, camera, pixels = _photograph("03.jpg")
    ape = pixels[223:363, 346:486].copy()
    pixels[223:363, 126:266] = ape
    pixels[223:363, 346:486] = cv2.GaussianBlur(ape, (0, 0), 6.5)
    three = pixels.copy()
    three[40:180, 236:376] = ape
    stream, results = FollowingStream(), messages.DetectResponse().results
    for frame in [pixels] * 25 + [three] * 70:
        track = messages.Tracking(num_objects=2)
        stream.follow(track, [detector], frame, camera, min_confidence=0.0, reduction=1, results=results)
    before, after = ({one.track.track_id: one for one in results[number].detections} for number in (24, 94))
    assert set(before) == {1, 2}
    assert set(after) == {1, 3}
    assert after[3].translation_m[1] < -0.1
    assert after[3].confidence > before[2].confidence + 0.2


def _three_spots(matrix: np.ndarray, width: int, height: int) -> onnx.ModelProto:
    """Finds one ball in each colour channel: where that is brightest, 1 m away, as confident as it is bright there."""
    rows, columns = np.mgrid[:height, :width]
    rays = np.stack([columns.ravel(), rows.ravel(), np.ones(width * height)], axis=1) @ np.linalg.inv(matrix).T
    constants = [
        numpy_helper.from_array(np.array([-1, 3, width * height]), "as_rows"),
        numpy_helper.from_array(np.array([2]), "pixels"),
        numpy_helper.from_array(rays.astype(np.float32), "rays"),
        numpy_helper.from_array(np.float32(255), "full"),
    ]
    nodes = [
        helper.make_node("Cast", ["image"], ["float"], to=TensorProto.FLOAT),
        helper.make_node("Transpose", ["float"], ["channels"], perm=[0, 3, 1, 2]),
        helper.make_node("Reshape", ["channels", "as_rows"], ["rows"]),
        helper.make_node("ArgMax", ["rows"], ["place"], axis=2, keepdims=0),
        helper.make_node("Gather", ["rays", "place"], ["translation_m"]),
        helper.make_node("ReduceMax", ["rows", "pixels"], ["brightest"], keepdims=0),
        helper.make_node("Div", ["brightest", "full"], ["confidence"]),
    ]
    outputs = {"translation_m": ["b", 3, 3], "confidence": ["b", 3]}
    values = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in outputs.items()]
    image = helper.make_tensor_value_info("image", TensorProto.UINT8, ["b", height, width, 3])
    graph = helper.make_graph(nodes, "balls", [image], values, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    fields = [
        Field(name="translation_m", size=3, per_object=True, unit="m", frame="camera"),
        Field(name="confidence", size=1, per_object=True, unit="1"),
    ]
    box = 0.05 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    ball = ObjectModel(name="ball", diameter_m=0.1, box_corners_m=box.ravel(), slots=[0, 1, 2])
    camera = CanonicalCamera(width=width, height=height, camera_matrix=matrix.ravel())
    spec = ModelSpec(
        schema_version=1, name="balls", world="balls", num_slots=3, fields=fields, objects=[ball], camera=camera
    )
    model.metadata_props.add(key=SPEC_KEY, value=json_format.MessageToJson(spec))
    return model


def test_an_object_that_is_read_twice_takes_no_other_ones_place() -> None:
    """Two are followed, one of them dim; then the bright one is found a second time, surer than the dim one."""
    matrix = np.array([[110.0, 0, 48.0], [0, 110.0, 32.0], [0, 0, 1]])
    detector = Detector(from_bytes(_three_spots(matrix, 96, 64).SerializeToString(), "balls"))
    once = np.zeros((64, 96, 3), np.uint8)
    once[30, 20, 0], once[30, 70, 2] = 230, 80
    twice = once.copy()
    twice[30, 21, 1] = 240
    stream, results = FollowingStream(), messages.DetectResponse().results
    for frame in (once, once, twice, once):
        track = messages.Tracking(num_objects=2)
        stream.follow(track, [detector], frame, PinholeCamera(matrix), min_confidence=0.0, reduction=1, results=results)
    for result in results:
        found = {one.track.track_id: one.translation_m[0] for one in result.detections}
        assert found == pytest.approx({1: -28 / 110, 2: 22 / 110}, abs=0.01)


def test_a_stream_keeps_its_version_and_numbers_are_given_once(
    start_server: Callable[..., Any],
    models_dir: Path,
    tmp_path: Path,
    spot_image: Callable[..., np.ndarray],
    spot_onnx: Callable[..., Any],
    write_folder: Callable[..., Path],
) -> None:
    folder = Path(shutil.copytree(models_dir / "pinhole", tmp_path / "models" / "pinhole"))
    server = start_server(folder.parent, "--refresh-s", "0.05")
    pixels = spot_image(320, 240, 150, 120, 12, 12, (255, 128, 0))
    matrix = np.array([[300.0, 0, 160.0], [0, 301.0, 119.0], [0, 0, 1]])

    answers: list[messages.RegionResult] = []

    def wait_until(is_met: Callable[[], bool]) -> None:
        end = time.monotonic() + 60
        while not is_met():
            assert time.monotonic() < end
            time.sleep(0.02)

    def requests() -> Iterator[messages.DetectRequest]:
        request = detect_request("pinhole", pixels, matrix, min_confidence=0.3, track=messages.Tracking())
        yield request
        wait_until(lambda: len(answers) == 1)
        write_folder(folder, spot_onnx(True), 2)
        wait_until(lambda: client.get_model("pinhole").version == 2)
        yield request
        wait_until(lambda: len(answers) == 2)
        shutil.rmtree(folder / "1")
        wait_until(lambda: client.list_models()[0].versions == [2])
        yield request

    with PoseClient(server.address) as client:
        for answer in client.detect_stream(requests(), timeout_s=120):
            answers.append(answer.results[0])  # while the generator waits for it
    assert [answer.model_version for answer in answers] == [1, 1, 2]
    assert [answer.detections[0].track.track_id for answer in answers] == [1, 1, 2]
