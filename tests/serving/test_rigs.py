"""Several cameras: poses in the rig's frame, rig files, requests that are none of a rig, and curio-detect --rig."""

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from curio_proto.v1 import detector_pb2 as messages
from curio_proto.v1.model_spec_pb2 import ObjectModel, Symmetry
from curio_serve.batch.arguments import DetectArguments
from curio_serve.batch.detect_cli import run
from curio_serve.client import PoseClient
from curio_serve.client.request import views_request
from curio_serve.consensus.poses import Predictions, consensus
from curio_serve.errors import ArgumentError, CameraError, CameraMissing, UsageError
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.models.detector import Detector
from curio_serve.models.model_folder import open_model
from curio_serve.rigs.detect_views import RigView, _explained, _Seen, _whole, detect_views
from curio_serve.rigs.rig import check_cam_from_rig, read_rig_file
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).parents[2]
K = np.array([[300.0, 0, 160.0], [0, 301.0, 119.0], [0, 0, 1]])
POSITION = np.array([0.02, 0.03, 1.2])  # of the spot, in the rig's frame
SPOT_M = 0.05
Spot = Callable[..., np.ndarray]


def _cameras() -> list[np.ndarray]:
    """cam_from_rig of two cameras that look at a place 1.2 m away from 60 degrees apart."""
    second = np.eye(4)
    second[:3, :3] = Rotation.from_euler("y", 60, degrees=True).as_matrix()
    second[:3, 3] = np.array([0, 0, 1.2]) - second[:3, :3] @ np.array([0, 0, 1.2])
    return [np.eye(4), second]


def _image(spot_image: Spot, cam_from_rig: np.ndarray, nearer: float = 1.0) -> np.ndarray:
    """The spot as a camera sees it; it looks as large as if it were so much nearer."""
    x, y, z = cam_from_rig[:3, :3] @ POSITION + cam_from_rig[:3, 3]
    u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
    return spot_image(320, 240, u, v, K[0, 0] * SPOT_M / z * nearer, K[1, 1] * SPOT_M / z * nearer, (255, 128, 0))


@pytest.fixture
def client(server) -> Iterator[PoseClient]:
    with PoseClient(server.address) as found:
        yield found


def test_what_one_camera_errs_in_depth_another_sees() -> None:
    """Two predictions, each wrong along its own ray, agree where both rays pass."""
    truth, rotations = np.array([0.0, 0.0, 1.0]), np.stack([np.eye(3)] * 3)
    rays = np.array([[0, 0, 1.0], [0.87, 0, 0.5], [1.0, 0, 0]])
    along = rays[:, :, None] * rays[:, None] / (rays**2).sum(axis=1)[:, None, None]
    covariance = (np.eye(3) - along) * 0.002**2 + along * 0.04**2
    positions = truth + rays * np.array([[0.03], [-0.03], [0.5]])
    found = consensus(
        Predictions(np.arange(3), rotations, positions, covariance), np.eye(3)[None], min_predictions=2, min_views=2
    )
    assert [one.members.tolist() for one in found] == [[0, 1]]
    assert np.linalg.norm(found[0].translation_m - truth) < 0.004
    same = Predictions(np.array([0, 0, 1]), rotations, positions, covariance)
    assert consensus(same, np.eye(3)[None], min_predictions=2, min_views=2) == []
    tilted = Predictions(np.arange(3), rotations @ np.diag([1.0, -1, -1]), positions, covariance)
    turned = Predictions(np.arange(3), np.stack([np.eye(3), np.diag([1.0, -1, -1]), np.eye(3)]), positions, covariance)
    assert len(consensus(tilted, np.eye(3)[None], min_predictions=2, min_views=2)) == 1
    assert consensus(turned, np.eye(3)[None], min_predictions=2, min_views=2) == []
    symmetric = np.stack([np.eye(3), np.diag([1.0, -1, -1])])
    assert len(consensus(turned, symmetric, min_predictions=2, min_views=2)) == 1


def test_views_of_a_ball_agree_by_its_place_alone() -> None:
    axes = [Symmetry(axis=axis, offset_m=[0.0] * 3) for axis in ([0.0, 0.6, 0.8], [1.0, 0.0, 0.0])]
    turned = Rotation.from_euler("xyz", (20, 70, -40), degrees=True).as_matrix()
    place_m, covariance = np.array([0.0, 0.0, 0.8]), np.eye(3) * 0.01**2
    seen = [_Seen(view, "ball", turn, place_m, covariance, 0.7) for view, turn in enumerate((np.eye(3), turned))]
    ((confidence, pose, _),) = _explained(seen, ObjectModel(name="ball", diameter_m=0.1, symmetries=axes))
    assert (pose.members.tolist(), confidence) == ([0, 1], pytest.approx(1 - 0.3**2))
    ((confidence, pose, _),) = _explained(seen, ObjectModel(name="brick", diameter_m=0.1))
    assert (pose.members.tolist(), confidence) == ([0], 0.7)


def test_a_shipped_model_sees_one_photograph_twice_and_agrees() -> None:
    """The second view is the first as a camera that is turned by 10 degrees sees it: known without a renderer."""
    camera = PinholeCamera(np.array(json.loads((ROOT / "samples" / "camera.json").read_text())["camera_matrix"]))
    truth = json.loads((ROOT / "samples" / "poses.json").read_text())["01.jpg"]
    position = next(np.array(pose["translation_m"]) for pose in truth if pose["object"] == "ape")
    pixels = np.ascontiguousarray(cv2.imread(str(ROOT / "samples" / "01.jpg"))[..., ::-1])
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("z", 10, degrees=True).as_matrix()
    homography = camera.matrix @ turn[:3, :3] @ np.linalg.inv(camera.matrix)
    turned = cv2.warpPerspective(pixels, homography, (640, 480), borderMode=cv2.BORDER_REPLICATE)
    results = messages.DetectResponse().results
    views = [RigView(pixels, camera, np.eye(4)), RigView(turned, camera, turn)]
    detector = Detector(open_model(ROOT / "models" / "ape"))
    detect_views(detector, views, results=results)
    (found,) = results[0].detections
    np.testing.assert_allclose(found.translation_m, position, atol=0.01)
    assert list(found.views) == [0, 1]
    assert found.confidence > detector.detect(pixels, camera)[0].detections[0].confidence
    assert not found.outside_trained_range

    longer = PinholeCamera(np.diag([1.8, 1.8, 1]) @ camera.matrix)  # the wrong K: everything is 1.8 times as far
    detect_views(detector, [RigView(pixels, longer, np.eye(4))] * 2, results=results)
    assert results[1].detections[0].outside_trained_range


def test_a_view_errs_along_its_own_ray() -> None:
    camera = PinholeCamera(np.array(json.loads((ROOT / "samples" / "camera.json").read_text())["camera_matrix"]))
    pixels = np.ascontiguousarray(cv2.imread(str(ROOT / "samples" / "03.jpg"))[..., ::-1])
    detector = Detector(open_model(ROOT / "models" / "ape"))
    kinds = {kind.name: kind for kind in detector.model.spec.objects}
    for turn_deg in (0, 90):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("y", turn_deg, degrees=True).as_matrix()
        (seen,) = _whole(detector, 0, RigView(pixels, camera, pose), kinds, lambda: None)
        variances, axes = np.linalg.eigh(seen.covariance_m2)
        assert variances[2] > 4 * variances[1]
        assert abs(axes[:, 2] @ seen.translation_m) / np.linalg.norm(seen.translation_m) > 0.99


def test_a_model_without_rotations_is_refused() -> None:
    model = open_model(ROOT / "models" / "ape")
    fields = [field for field in model.spec.fields if not field.name.startswith("rotation")]
    del model.spec.fields[:]
    model.spec.fields.extend(fields)
    view = RigView(np.zeros((480, 640, 3), np.uint8), PinholeCamera(K), np.eye(4))
    with pytest.raises(ArgumentError, match="answers no rotations"):
        detect_views(Detector(model), [view, view], results=messages.DetectResponse().results)


def test_requests_with_views_are_answered_in_the_rigs_frame(client: PoseClient, spot_image: Spot) -> None:
    views = [(_image(spot_image, pose), K, pose) for pose in _cameras()]
    answer = client.detect_views("pinhole", views, min_confidence=0.3)
    (found,) = answer.results[0].detections
    # The spot's rotation is the same in each camera, so cameras that stand apart do not agree on it: one answers.
    assert len(found.views) == 1
    np.testing.assert_allclose(found.translation_m, POSITION, atol=0.02)
    side = np.eye(4)
    side[0, 3] = -0.1
    answer = client.detect_views("pinhole", [(_image(spot_image, pose), K, pose) for pose in (np.eye(4), side)])
    (found,) = answer.results[0].detections
    assert list(found.views) == [0, 1]
    np.testing.assert_allclose(found.translation_m, POSITION, atol=0.02)
    assert len(found.box_px) == 16


def test_what_is_no_rig_is_refused_by_name_and_the_stream_goes_on(client: PoseClient, spot_image: Spot) -> None:
    image = _image(spot_image, np.eye(4))
    mirrored, singular, stretched = np.diag([-1.0, 1, 1, 1]), np.diag([1.0, 1, 0, 1]), np.diag([1.1, 1, 1, 1])
    good = (image, K, np.eye(4))
    requests = [
        views_request("pinhole", [good]),
        views_request("pinhole", [good] * 17),
        views_request("pinhole", [good, (image, K, mirrored)]),
        views_request("pinhole", [good, (image, K, singular)]),
        views_request("pinhole", [good, (image, K, stretched)]),
        views_request("pinhole", [good, (image, K, np.eye(3))]),
        views_request("pinhole", [good, (image, K, np.full((4, 4), np.nan))]),
        views_request("pinhole", [good, (image, None, np.eye(4))]),
        views_request("flat", [good, good]),
        views_request("pinhole", [good, good]),
    ]
    requests[-2].apply_exif_rotation = True
    both = views_request("pinhole", [good, good])
    both.track.num_objects = 1
    answers = list(client.detect_stream([both, *requests], timeout_s=60))
    texts = [answer.error.message for answer in answers]
    for text, part in zip(
        texts,
        (
            *("track", "views has 1 entries; expected 2 to 16", "views has 17", "left-handed", "singular"),
            *("not rigid", "9 values; expected 16", "not finite", "has no camera", "apply_exif_rotation", ""),
        ),
        strict=True,
    ):
        assert part in text
    reasons = [answer.error.reason for answer in answers]
    assert reasons == ["ArgumentError"] * 3 + ["CameraError"] * 5 + ["CameraMissing", "ArgumentError", ""]
    assert answers[-1].results[0].detections
    with pytest.raises(CameraError, match=r"views\[1\].cam_from_rig is left-handed"):
        client.detect_views("pinhole", [good, (image, K, mirrored)])
    with pytest.raises(CameraMissing):
        client.detect_views("pinhole", [good, (image, None, np.eye(4))])
    with pytest.raises(ArgumentError):
        client.detect_views("pinhole", [good])


def _write_rig(path: Path, poses: list[np.ndarray], **changes: object) -> Path:
    cameras = [
        {"name": f"cam{n}", "camera_matrix": K.tolist(), "width": 320, "height": 240, "cam_from_rig": pose.tolist()}
        for n, pose in enumerate(poses)
    ]
    cameras[-1] |= changes
    path.write_text(json.dumps({"cameras": cameras}))
    return path


def test_curio_detect_takes_a_folder_of_each_camera(
    models_dir: Path, tmp_path: Path, spot_image: Spot, capsys: pytest.CaptureFixture[str]
) -> None:
    side = np.eye(4)
    side[0, 3] = -0.1
    poses = [side, np.eye(4)]
    rig, folders, out = _write_rig(tmp_path / "rig.json", poses), [], tmp_path / "out.jsonl"
    for number, pose in enumerate(poses):
        folders.append(tmp_path / f"cam{number}")
        folders[-1].mkdir()
        for frame in range(3):
            cv2.imwrite(str(folders[-1] / f"{frame}.png"), _image(spot_image, pose)[..., ::-1])
    (folders[1] / "1.png").write_bytes(b"no picture")
    call = DetectArguments(str(models_dir / "pinhole"), tuple(map(str, folders)), rig=rig, out=str(out))
    assert run(call) == 1
    assert "the middle alone was searched, 59% of the frame" in capsys.readouterr().err
    first, broken, last = (json.loads(line) for line in out.read_text().splitlines())
    assert first["views"] == [str(folder / "0.png") for folder in folders]
    np.testing.assert_allclose(first["detections"][0]["translation_m"], POSITION, atol=0.02)
    assert first["cam_from_rig"] == last["cam_from_rig"] == side.tolist()
    assert first["detections"][0]["views"] == last["detections"][0]["views"] == [0, 1]
    assert str(folders[1] / "1.png") in broken["error"]
    photograph = folders[0] / "0.png"
    before = photograph.read_bytes()
    with pytest.raises(UsageError, match="is an image, a video or a model"):
        run(DetectArguments(call.model, call.images, rig=rig, out=str(photograph), overwrite=True))
    assert photograph.read_bytes() == before
    again = shutil.copytree(models_dir / "pinhole", tmp_path / "again" / "pinhole")
    with pytest.raises(UsageError, match="two models are pinhole/"):
        run(DetectArguments(call.model, (str(again), *call.images), rig=rig, out=str(tmp_path / "twice.jsonl")))
    (folders[1] / "2.png").unlink()
    with pytest.raises(UsageError, match=r"as many images of each camera; .*cam1 has 2"):
        run(DetectArguments(call.model, call.images, rig=rig, out=str(tmp_path / "other.jsonl")))
    with pytest.raises(UsageError, match=r"has 2 cameras .cam0, cam1., found 1 IMAGES"):
        run(DetectArguments(call.model, call.images[:1], rig=rig))
    with pytest.raises(UsageError, match="--camera"):
        run(DetectArguments(call.model, call.images, rig=rig, camera=rig))
    with pytest.raises(UsageError, match="--rig and --mesh"):
        run(DetectArguments(call.model, call.images, rig=rig, mesh=(rig,)))
    with pytest.raises(UsageError, match="JSON Lines"):
        run(DetectArguments(call.model, call.images, rig=rig, format="csv"))
    with pytest.raises(UsageError, match="behind a server"):
        run(DetectArguments("127.0.0.1:1/pinhole", call.images, rig=rig))


@pytest.mark.parametrize("is_right", [True, False])
def test_cameras_that_never_agree_are_told(
    is_right: bool, models_dir: Path, tmp_path: Path, spot_image: Spot, capsys: pytest.CaptureFixture[str]
) -> None:
    side, folders = np.eye(4), [tmp_path / "cam0", tmp_path / "cam1"]
    side[0, 3] = -0.2
    for folder, pose in zip(folders, (side, np.eye(4)), strict=True):
        folder.mkdir()
        for frame in range(10):
            cv2.imwrite(str(folder / f"{frame}.png"), _image(spot_image, pose)[..., ::-1])
    out, first = tmp_path / "out", side if is_right else np.linalg.inv(side)
    rig = _write_rig(tmp_path / "rig.json", [first, np.eye(4)])
    call = DetectArguments(str(models_dir / "pinhole"), tuple(map(str, folders)), rig=rig, out=str(out))
    run(call)
    told = "in none of 10 instants do two cameras agree on a pose: are their cam_from_rig"
    assert (told in capsys.readouterr().err) is not is_right
    out.write_text(out.read_text().splitlines(keepends=True)[0])
    _write_rig(rig, [side, np.eye(4)], name="right")
    with pytest.raises(UsageError, match=r'answers with other options: .*"rig_sha256"'):
        run(call)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("[", "not JSON"),
        ("[]", "no list of cameras"),
        ('{"cameras": [1, 2]}', "is no object"),
        ('{"cameras": [{"camera_matrix": "x", "cam_from_rig": 1}, {}]}', "no numbers"),
    ],
)
def test_files_that_describe_no_rig_are_refused(tmp_path: Path, content: str, said: str) -> None:
    (tmp_path / "rig.json").write_text(content)
    with pytest.raises(CameraError, match=said):
        read_rig_file(tmp_path / "rig.json")


def test_rig_files_are_read_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "rig.json"
    first, second = read_rig_file(_write_rig(path, _cameras()))
    assert (first.name, first.camera.size) == ("cam0", (320, 240))
    np.testing.assert_allclose(second.cam_from_rig, _cameras()[1])
    with pytest.raises(CameraError, match="has 1 cameras"):
        read_rig_file(_write_rig(path, _cameras()[:1]))
    with pytest.raises(CameraError, match=r"cameras\[1\]: K is singular"):
        read_rig_file(_write_rig(path, _cameras(), camera_matrix=np.diag([0.0, 1, 1]).tolist()))
    with pytest.raises(CameraError, match=r"cameras\[1\].cam_from_rig is left-handed"):
        read_rig_file(_write_rig(path, _cameras(), cam_from_rig=np.diag([-1.0, 1, 1, 1]).tolist()))
    millimetres = np.array(_cameras()[1]) * [1, 1, 1, 1000] / [[1], [1], [1], [1000]]
    with pytest.raises(CameraError, match=r"cameras 0 and 1 are 1200 m apart.*are these millimetres"):
        read_rig_file(_write_rig(path, _cameras(), cam_from_rig=millimetres.tolist()))
    lens = {"distortion": None, "distortion_coefficients": [-0.2, 0.1, 0, 0, 0]}
    assert read_rig_file(_write_rig(path, _cameras(), **lens))[1].camera.distortion == (-0.2, 0.1, 0, 0, 0)
    with pytest.raises(CameraError, match=r"cameras\[1\]: distortion_model is 'equidistant'"):
        read_rig_file(_write_rig(path, _cameras(), distortion=[0.1, 0, 0, 0], distortion_model="equidistant"))
    with pytest.raises(CameraError, match="cannot be read"):
        read_rig_file(tmp_path / "none.json")
    with pytest.raises(CameraError, match="last row"):
        check_cam_from_rig(np.ones((4, 4)), "rig")
