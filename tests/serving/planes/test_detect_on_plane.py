"""Poses that are moved onto a plane: in process, on the command line and over gRPC."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import pytest
from curio_proto.v1 import detector_pb2 as messages
from curio_proto.v1.model_spec_pb2 import ModelSpec
from curio_serve.batch.arguments import DetectArguments
from curio_serve.batch.detect_cli import run
from curio_serve.client import Plane, PoseClient
from curio_serve.client.request import detect_request, views_request
from curio_serve.errors import ArgumentError, ModelError, UsageError
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.models.answers import standing_shapes
from curio_serve.models.detector import Detector
from curio_serve.models.model_folder import open_model

K = np.array([[300.0, 0, 160.0], [0, 301.0, 119.0], [0, 0, 1]])
ROOT = Path(__file__).parents[3]


def _detect(folder: Path, pixels: np.ndarray, **options: Any) -> messages.RegionResult:
    (result,) = Detector(open_model(folder)).detect(pixels, PinholeCamera(K), **options)
    return result


def test_a_pose_moves_along_its_line_of_sight(standing: Path, pixels: np.ndarray, below: Callable[..., Plane]) -> None:
    before = _detect(standing, pixels).detections[0]
    assert not before.on_plane
    plane = below(before, 0.01)
    result = _detect(standing, pixels, plane=plane)
    (found,) = result.detections
    assert found.on_plane
    assert np.allclose(result.plane.normal, plane.normal)
    was_m, now_m = np.array(before.translation_m), np.array(found.translation_m)
    assert np.linalg.norm(np.cross(was_m, now_m)) < 1e-9
    farther_m = np.linalg.norm(now_m) - np.linalg.norm(was_m)
    assert 0.006 < farther_m < 0.01  # most of the way: a plane is not known exactly either
    assert list(found.rotation) == list(before.rotation)
    spread = [np.ptp(np.reshape(one.box_px, (8, 2)), axis=0) for one in (before, found)]
    assert (spread[1] < spread[0]).all()  # what is farther away is smaller


def test_what_keeps_its_direction_is_the_middle(
    tmp_path: Path,
    spot_onnx: Callable[..., onnx.ModelProto],
    spot_spec: Callable[[bool], ModelSpec],
    write_folder: Callable[..., Path],
    pixels: np.ndarray,
    with_stable_poses: Callable[[Path], Path],
    below: Callable[..., Plane],
) -> None:
    spec = spot_spec(True)
    spec.objects[0].center_m[:] = [0.03, 0.02, -0.04]
    folder = with_stable_poses(write_folder(tmp_path / "models" / "pinhole", spot_onnx(True, spec)))
    before = _detect(folder, pixels).detections[0]
    plane = below(before, 0.01)
    found = _detect(folder, pixels, plane=plane).detections[0]
    assert found.on_plane
    origins_m = [np.array(one.translation_m) for one in (before, found)]
    from_origin_m = np.reshape(before.rotation, (3, 3)) @ spec.objects[0].center_m
    middles_m = [origin_m + from_origin_m for origin_m in origins_m]
    assert np.linalg.norm(np.cross(*middles_m)) < 1e-9
    assert np.linalg.norm(np.cross(*origins_m)) > 1e-5
    (hull_m,) = [np.reshape(one.hull_m, (-1, 3)) for one in open_model(folder).spec.stable_poses.objects]
    seen_m = hull_m @ np.reshape(found.rotation, (3, 3)).T + found.translation_m
    assert (seen_m @ plane.normal).min() == pytest.approx(plane.offset_m, abs=0.003)


def test_a_pose_that_does_not_stand_there_stays(
    standing: Path, pixels: np.ndarray, below: Callable[..., Plane]
) -> None:
    before = _detect(standing, pixels).detections[0]
    result = _detect(standing, pixels, plane=below(before, 0.4))
    assert result.detections[0].translation_m == before.translation_m
    assert not result.detections[0].on_plane
    assert result.HasField("plane")


def test_the_plane_is_found_where_two_objects_stand_on_it(standing: Path, pair: Path, pixels: np.ndarray) -> None:
    assert not _detect(standing, pixels, plane="objects").HasField("plane")  # one object stands on any
    result = _detect(pair, pixels, plane="objects")
    assert [one.on_plane for one in result.detections] == [True, True]
    heights_m = [np.array(one.translation_m) @ result.plane.normal for one in result.detections]
    assert np.ptp(heights_m) < 0.002


def test_objects_that_are_chosen_stand_on_a_plane() -> None:
    model = open_model(ROOT / "models" / "lmo").of(["can", "ape", "cat"])
    assert [one.object for one in model.spec.stable_poses.objects] == ["ape", "can", "cat"]
    pixels = cv2.imread(str(ROOT / "samples" / "00.jpg"))[..., ::-1]
    camera = json.loads((ROOT / "samples" / "camera.json").read_text())["camera_matrix"]
    (result,) = Detector(model).detect(pixels, PinholeCamera(np.array(camera)), plane="objects")
    assert {found.object for found in result.detections} == {"ape", "can", "cat"}


def test_the_sides_of_a_ball_tell_no_plane(pair: Path) -> None:
    model = open_model(pair)
    assert len(standing_shapes(model)["spot"].up) == 6
    for axis in ([0.0, 0.0, 1.0], [1.0, 0.0, 0.0]):
        model.spec.objects[0].symmetries.add(axis=axis, offset_m=[0.0] * 3)
    assert len(standing_shapes(model)["spot"].up) == 0


def test_a_model_that_does_not_say_how_objects_stand_refuses(models_dir: Path, pixels: np.ndarray) -> None:
    with pytest.raises(ArgumentError, match="model pinhole/1 does not say how its objects stand"):
        _detect(models_dir / "pinhole", pixels, plane="objects")


def test_a_flat_world_refuses_whatever_lies_beside_it(
    tmp_path: Path,
    spot_onnx: Callable[..., onnx.ModelProto],
    write_folder: Callable[..., Path],
    pixels: np.ndarray,
    with_stable_poses: Callable[[Path], Path],
) -> None:
    folder = with_stable_poses(write_folder(tmp_path / "models" / "flat", spot_onnx(False)))
    with pytest.raises(ArgumentError, match="model flat/1 does not say how its objects stand"):
        Detector(open_model(folder)).detect(pixels, None, plane="objects")


def test_a_file_that_was_changed_or_lost_is_refused(standing: Path) -> None:
    file = standing / "1" / "stable_poses.json"
    file.write_text(json.dumps(json.loads(file.read_text()), indent=1))
    with pytest.raises(ModelError, match=r"stable_poses\.json has SHA-256"):
        open_model(standing)
    file.unlink()
    with pytest.raises(ModelError, match=r"stable_poses\.json is missing"):
        open_model(standing)


def test_over_grpc(
    standing: Path, pair: Path, start_server: Callable[..., Any], pixels: np.ndarray, below: Callable[..., Plane]
) -> None:
    before = _detect(standing, pixels).detections[0]
    plane = below(before, 0.01)
    expected = _detect(standing, pixels, plane=plane).detections[0]
    with PoseClient(start_server(standing.parent).address) as client:
        (result,) = client.detect("pinhole", pixels, K, plane=plane).results
        found = client.detect(["pinhole", "pair"], pixels, K, plane="objects").results
        assert client.get_model("pinhole").spec.stable_poses.objects[0].object == "spot"
        with pytest.raises(ArgumentError, match=r"values of a point|expected three numbers each"):
            client.detect("pinhole", pixels, K, plane=Plane(None, None))  # type: ignore[arg-type]
        with pytest.raises(ArgumentError, match="expected a Plane, 'objects' or None"):
            client.detect("pinhole", pixels, K, plane="table")  # type: ignore[arg-type]
        impossible = detect_request("pinhole", pixels, K, plane=plane)
        del impossible.plane.normal[:]
        followed = detect_request("pinhole", pixels, K, plane=plane, track=messages.Tracking())
        answers = list(client.detect_stream([impossible, followed], timeout_s=60))
        views = views_request("pinhole", [(pixels, K, np.eye(4)), (pixels, K, np.eye(4))])
        views.plane.CopyFrom(messages.Plane())
        answers += client.detect_stream([views], timeout_s=60)
    assert result.detections[0].translation_m == pytest.approx(expected.translation_m)
    assert result.detections[0].on_plane
    assert [[one.on_plane for one in of_model.detections] for of_model in found] == [[False], [True, True]]
    told = [answer.error.message for answer in answers]
    assert "3 values of a point and 0 of a normal" in told[0]
    assert answers[1].results[0].detections[0].translation_m == pytest.approx(expected.translation_m, abs=0.002)
    assert "the request has views and plane" in told[2]


def test_the_command_line(
    standing: Path, pair: Path, frames: Path, camera: Path, tmp_path: Path, below: Callable[..., Plane]
) -> None:
    """A camera that stands still, and cameras whose poses are named."""
    out, poses = tmp_path / "out.jsonl", tmp_path / "views.json"
    call = DetectArguments(str(standing), (str(frames),), camera=camera, out=str(out), overwrite=True, jobs=1)
    assert run(call) == 0
    before = [json.loads(line)["detections"][0] for line in out.read_text().splitlines()]
    plane = below(
        messages.Detection(translation_m=before[0]["translation_m"], rotation=np.ravel(before[0]["rotation"])), 0.01
    )
    pose = {"cam_from_world": _pose_over(plane).tolist()}
    for content, num_moved in ((pose, 6), ({"000000.png": pose}, 1)):
        poses.write_text(json.dumps(content))
        assert run(replace(call, plane=str(poses), track=True)) == int(num_moved < 6)
        assert out.read_text().count('"plane": {') == num_moved
        assert run(replace(call, plane=str(poses))) == int(num_moved < 6)
        lines = [json.loads(line) for line in out.read_text().splitlines()]
        assert len([line for line in lines if "plane" in line]) == num_moved
        assert lines[0]["detections"][0]["on_plane"]
        assert np.allclose(lines[0]["plane"]["normal"], plane.normal)
    assert "has no pose of 000005.png" in lines[-1]["error"]
    poses.write_text(json.dumps(pose))
    assert run(replace(call, plane=str(poses), track=True)) == 0
    followed = [json.loads(line)["detections"][0] for line in out.read_text().splitlines()]
    assert all("track" in one for one in followed)
    assert followed[0]["translation_m"] == pytest.approx(lines[0]["detections"][0]["translation_m"], abs=0.002)
    assert run(replace(call, plane="objects", track=True, track_objects=2)) == 0
    assert run(replace(call, model=str(pair), plane="objects", track=True, track_objects=2)) == 0
    assert run(replace(call, model=str(pair), plane="objects")) == 0
    assert all("plane" in json.loads(line) for line in out.read_text().splitlines())


def test_a_file_that_changed_is_another_option(tmp_path: Path) -> None:
    """Its name alone would let a result file go on with poses over another plane."""
    plane = tmp_path / "plane.json"
    found = []
    for height in (1.0, 1.3, 1.0):
        plane.write_text(json.dumps({"height_m": height}))
        found.append(DetectArguments("m", ("a.png",), plane=str(plane)).changed_options)
    assert found[0] == found[2] != found[1]
    assert found[0]["plane"] == str(plane)
    assert DetectArguments("m", ("a.png",), plane="objects").changed_options == {"plane": "objects"}


def _pose_over(plane: Plane) -> np.ndarray:
    """The cam_from_world of a plane at y = 0."""
    across = np.cross(plane.normal, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([across, plane.normal, np.cross(across, plane.normal)], axis=1)
    pose[:3, 3] = plane.point_m
    return pose


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"plane": "nowhere.json"}, r"--plane nowhere\.json: cannot be read"),
        ({"plane": "objects", "track": True}, "finds one object in an image"),
        ({"plane": "objects"}, "finds one object in an image, which stands on any plane"),
        ({"plane": "objects", "refine": True}, "--refine and --plane both correct distances"),
        ({"plane": "up.json"}, r"b\.png: cam_from_world has shape"),
        ({"plane": "views.json", "exif_rotation": True}, "leave out --exif-rotation"),
        ({"plane": "views.json", "video": "0", "images": (), "out": None, "overwrite": False}, "named photographs"),
        ({"plane": "objects", "model": "FLAT"}, "model flat does not say how its objects stand"),
    ],
)
def test_wrong_calls(
    standing: Path, models_dir: Path, frames: Path, camera: Path, tmp_path: Path, changes: dict[str, Any], told: str
) -> None:
    views, up = tmp_path / "views.json", tmp_path / "up.json"
    over = _pose_over(Plane.of([0.0, 0.1, 1.0], [0.0, -0.8, -0.6]))
    views.write_text(json.dumps({"a.png": {"cam_from_world": over.tolist()}}))
    up.write_text(json.dumps({"a.png": {"cam_from_world": over.tolist()}, "b.png": {"cam_from_world": [[]]}}))
    call = DetectArguments(str(standing), (str(frames),), camera=camera, out=str(tmp_path / "out.jsonl"))
    named = {"views.json": str(views), "up.json": str(up), "FLAT": str(models_dir / "flat")}
    with pytest.raises(UsageError, match=told):
        run(
            replace(
                call,
                **{key: named.get(value, value) if isinstance(value, str) else value for key, value in changes.items()},
            )
        )
