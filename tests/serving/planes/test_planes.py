"""Planes on which objects stand: what is given, what is found, and how far away an object is that stands on one."""

import json
import pickle
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from curio_serve.batch.cluster import for_other_nodes
from curio_serve.batch.images.source_image import SourceImage
from curio_serve.errors import ArgumentError, CameraError, ModelError
from curio_serve.planes.camera_poses import CameraPoseFile, plane_of
from curio_serve.planes.plane import FIND_PLANE, Plane
from curio_serve.planes.stable_poses import parse_stable_poses
from curio_serve.planes.standing import Standing, distance_factor, find_plane
from scipy.spatial.transform import Rotation

SIZE_M = np.array([0.1, 0.06, 0.04])
CORNERS_M = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * SIZE_M / 2
SIDES = np.concatenate([np.eye(3), -np.eye(3)])
TABLE = Plane.of([0.0, 0.1, 1.0], [0.0, -0.8, -0.6])


def _brick(rotation: np.ndarray, middle_m: np.ndarray, weight: float = 0.8) -> Standing:
    return Standing(weight, middle_m, CORNERS_M @ rotation.T + middle_m, SIDES @ rotation.T)


def _on_table(seed: int, distance: float = 1.0, plane: Plane = TABLE) -> Standing:
    """A brick on one of its sides, as one reads it whose distances are off by a factor."""
    random = np.random.default_rng(seed)
    side, turn = seed % 3, random.uniform(0, 2 * np.pi)
    to_normal, _ = Rotation.align_vectors(plane.normal[None], SIDES[side][None])
    rotation = (Rotation.from_rotvec(turn * plane.normal) * to_normal).as_matrix()
    on_plane = (
        plane.point_m + np.cross(plane.normal, [1.0, 0, 0]) * random.uniform(-0.2, 0.2) + [0.2 * seed - 0.4, 0, 0]
    )
    on_plane -= plane.normal * (plane.normal @ (on_plane - plane.point_m))
    return _brick(rotation, distance * (on_plane + plane.normal * SIZE_M[side] / 2))


def _lost(seed: int) -> Standing:
    random = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=seed).as_matrix()
    return _brick(rotation, np.array([*random.uniform(-0.3, 0.3, 2), random.uniform(0.7, 1.3)]), 0.3)


@pytest.mark.parametrize("factors", [(1.0, 1.0), (0.99, 1.01, 1.0), (1.012, 0.985, 1.0, 1.004, 0.996)])
def test_objects_tell_the_plane_on_which_they_stand(factors: Sequence[float]) -> None:
    standing = [_on_table(seed, factor) for seed, factor in enumerate(factors)]
    for others in ([], [_lost(20), _lost(21)]):
        found = find_plane([*standing, *others])
        assert found is not None
        assert found.normal @ TABLE.normal > np.cos(np.radians(2.5))
        assert found.normal @ TABLE.point_m == pytest.approx(found.offset_m, abs=0.01)


def test_the_plane_is_the_mean_of_what_objects_tell() -> None:
    """Each leans by three degrees, to another side."""
    axes = np.array([[1, 0, 0], [-1, 0, 0], [0, 0, 1], [0, 0, -1]])
    tilts = [Rotation.from_rotvec(np.radians(3) * axis) for axis in axes]
    bricks = [_on_table(seed) for seed in range(4)]
    leaning = []
    for brick, tilt in zip(bricks, tilts, strict=True):
        matrix = tilt.as_matrix()
        hull_m = (brick.hull_m - brick.middle_m) @ matrix.T + brick.middle_m
        leaning.append(replace(brick, hull_m=hull_m, up=brick.up @ matrix.T))
    found = find_plane(leaning)
    assert found is not None
    assert found.normal @ TABLE.normal > np.cos(np.radians(1.2))


def test_surer_objects_tell_more_of_the_plane() -> None:
    other = Plane.of(TABLE.point_m + 0.2 * TABLE.normal, TABLE.normal)
    unsure = [replace(_on_table(seed, plane=other), weight=0.2) for seed in (0, 2)]
    found = find_plane([*unsure, _on_table(1), _on_table(3)])
    assert found is not None
    assert found.normal @ TABLE.point_m == pytest.approx(found.offset_m, abs=0.005)
    heights_m = []
    for weights in ((0.9, 0.1), (0.1, 0.9)):  # two that do not agree exactly
        pair = [replace(_on_table(0, 1.01), weight=weights[0]), replace(_on_table(3, 0.99), weight=weights[1])]
        found = find_plane(pair)
        assert found is not None
        heights_m.append(found.normal @ TABLE.point_m - found.offset_m)
    assert heights_m[0] > heights_m[1] + 0.002


def test_no_plane_is_found_where_no_two_objects_agree() -> None:
    assert find_plane([]) is None
    assert find_plane([_on_table(0)]) is None
    assert find_plane([_on_table(0), _on_table(1, plane=Plane.of([0, 0, 1.4], [0.9, 0, -0.3]))]) is None
    twice = _on_table(0)  # in two regions of a frame
    assert find_plane([twice, replace(twice, weight=0.5), _lost(20)]) is None
    assert find_plane([_on_table(0), replace(_on_table(1), weight=0.04)]) is None  # what may not be there
    ball = Standing(0.9, np.array([0, 0, 1.0]), CORNERS_M + np.array([0, 0, 1.0]), np.zeros((0, 3)))
    assert find_plane([ball, ball, _on_table(0)]) is None


@pytest.mark.parametrize("factor", [0.98, 1.0, 1.02])
def test_an_object_moves_until_it_stands_on_a_plane(factor: float) -> None:
    standing = _on_table(1, factor)
    found = distance_factor(standing, TABLE, is_known=False)
    assert found is not None
    assert found * factor == pytest.approx(1, abs=0.004)  # the plane is trusted to millimetres, not entirely


def test_an_object_that_leans_touches_a_known_plane_and_does_not_stand_on_one_that_was_found() -> None:
    turned = Rotation.from_rotvec([0.5, 0, 0.5]).as_matrix()
    lowest_m = (CORNERS_M @ turned.T @ TABLE.normal).min()
    leaning = _brick(turned, 1.01 * (TABLE.point_m - lowest_m * TABLE.normal))
    assert distance_factor(leaning, TABLE, is_known=False) is None
    found = distance_factor(leaning, TABLE, is_known=True)
    assert found is not None
    assert found * 1.01 == pytest.approx(1, abs=0.003)


@pytest.mark.parametrize("is_known", [False, True])
def test_an_object_that_cannot_stand_there_stays(is_known: bool) -> None:
    too_far = _on_table(0, 1.2)  # to be an error of reading
    assert distance_factor(too_far, TABLE, is_known=is_known) is None
    under = Plane(TABLE.normal * 0.5, -TABLE.normal)
    assert distance_factor(_on_table(0), under, is_known=is_known) is None


@pytest.mark.parametrize(
    ("point_m", "normal", "told"),
    [
        ([0, 0], [0, 0, -1], "2 values of a point and 3 of a normal"),
        (["far"], [0, 0, -1], "expected three numbers each"),
        ([0, 0, 1], [], "3 values of a point and 0 of a normal"),
        ([0, 0, 1], [0, 0, 0], "expected metres and a direction"),
        ([0, 0, np.nan], [0, 0, -1], "expected metres and a direction"),
        ([0, 0, 1], [0, 0, -1e300], "expected metres and a direction"),
        ([0, 0, 1e5], [0, 0, -1], "expected metres and a direction"),
        ([0, 0, 1], [0, 0, 1], "seen from below"),
    ],
)
def test_an_impossible_plane_is_refused(point_m: list[Any], normal: list[float], told: str) -> None:
    with pytest.raises(ArgumentError, match=told):
        Plane.of(point_m, normal)


def test_a_file_of_camera_poses_says_the_plane_in_each_camera(tmp_path: Path) -> None:
    """A metre above y = 0, looking down and forward: the point below the camera is a metre away along its down axis."""
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = [[1, 0, 0], [0, -0.6, 0.8], [0, -0.8, -0.6]]
    cam_from_world[:3, 3] = -cam_from_world[:3, :3] @ [0, 1, 0]
    for content in (
        {"a.png": {"cam_from_world": cam_from_world.tolist()}},
        {"cam_from_world": cam_from_world.tolist()},
    ):
        (tmp_path / "views.json").write_text(json.dumps(content))
        poses = CameraPoseFile.read(tmp_path / "views.json")
        plane = poses.plane(tmp_path / "a.png")
        assert plane.offset_m == pytest.approx(-1)
        assert plane.normal.tolist() == [0, -0.6, -0.8]
    level = {"cam_from_world": [[1, 0, 0, 0], [0, -1, 0, 1], [0, 0, -1, 0], [0, 0, 0, 1]]}
    (tmp_path / "level.json").write_text(json.dumps(level))
    assert CameraPoseFile.read(tmp_path / "level.json").plane(tmp_path / "a.png").normal.tolist() == [0, -1, 0]
    assert poses.plane(tmp_path / "any.png").offset_m == pytest.approx(-1)  # of a camera that stands still
    assert plane_of(FIND_PLANE, "a.png") == FIND_PLANE
    assert plane_of(None, "a.png") is None


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (None, "cannot be read"),
        ("{", "not JSON"),
        ('{"b.png": {"cam_from_world": []}}', r"has no pose of a\.png, only of b\.png"),
        ('{"cam_from_world": 3}', "expected 4x4"),
        ('{"cam_from_world": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}', "looks straight ahead"),
        ('{"cam_from_world": [[1,0,0,0],[0,-0.6,-0.8,1],[0,0.8,-0.6,0],[0,0,0,1]]}', "height of 0.6 m and looks up"),
        ('{"cam_from_world": [[1,0,0,0],[0,-1,0,900],[0,0,-1,0],[0,0,0,1]]}', "found millimetres"),
        ('{"unit": "mm", "cam_from_world": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}', "the unit is 'mm'"),
    ],
)
def test_a_file_without_the_plane_is_refused(tmp_path: Path, content: str | None, told: str) -> None:
    if content is not None:
        (tmp_path / "views.json").write_text(content)
    with pytest.raises(CameraError, match=told):
        CameraPoseFile.read(tmp_path / "views.json").plane(tmp_path / "a.png")


def test_a_photograph_of_the_same_name_in_another_folder_is_not_taken_for_it(tmp_path: Path) -> None:
    for folder in ("left", "right"):
        (tmp_path / folder).mkdir()
    (tmp_path / "views.json").write_text(json.dumps({"a.png": {"cam_from_world": [], "folder": "left"}}))
    with pytest.raises(CameraError, match=r"has no pose of a\.png, but of one of that name in left"):
        CameraPoseFile.read(tmp_path / "views.json").plane(tmp_path / "right" / "a.png")
    with pytest.raises(CameraError, match=r"has no pose of a\.png, but of one of that name in left"):
        CameraPoseFile.read(tmp_path / "views.json").plane(tmp_path / "a.png")
    with pytest.raises(CameraError, match="expected 4x4"):
        CameraPoseFile.read(tmp_path / "views.json").refuse_impossible_planes()


def test_photographs_are_found_from_another_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on another node of a cluster."""
    for folder in ("left", "right"):
        (tmp_path / folder).mkdir()
    pose = {"cam_from_world": np.eye(4).tolist()}
    (tmp_path / "views.json").write_text(json.dumps({"a.png": {**pose, "folder": "left"}, "right/b.png": pose}))
    monkeypatch.chdir(tmp_path)
    images = [for_other_nodes(SourceImage(name, name)) for name in ("left/a.png", "right/a.png", "right/b.png")]
    sent = pickle.dumps(CameraPoseFile.read(Path("views.json")))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    there = pickle.loads(sent)
    assert [there.is_known(Path(image.place)) for image in images] == [True, False, True]


OF_BRICK = {"object": "brick", "hull_m": CORNERS_M.ravel().tolist(), "up": SIDES.ravel().tolist()}


@pytest.mark.parametrize(
    ("objects", "told"),
    [
        ([], r"is about \[\], the model finds \['brick'\]"),
        ([OF_BRICK | {"hull_m": []}], "impossible values"),
        ([OF_BRICK | {"hull_m": [0.1, 0.2]}], "impossible values"),
        ([OF_BRICK | {"hull_m": [0.1, 0.2, "NaN"]}], "impossible values"),
        ([OF_BRICK | {"up": [1, 1, 1]}], "impossible values"),
        (3, "is not what curio-export writes"),
    ],
)
def test_stable_poses_that_cannot_be_are_refused(objects: object, told: str) -> None:
    assert len(parse_stable_poses(json.dumps({"objects": [OF_BRICK]}).encode(), ["brick"], "f").objects) == 1
    with pytest.raises(ModelError, match=told):
        parse_stable_poses(json.dumps({"objects": objects}).encode(), ["brick"], "f")
