"""How objects can stand: sides of known bodies, the file beside a model, and estimates moved onto a plane."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from curio_serve.planes.camera_poses import CameraPoseFile
from curio_serve.planes.plane import FIND_PLANE, Plane
from curio_serve.planes.stable_poses import STABLE_POSES_FILE, parse_stable_poses
from curio_train.data.bop import Frame
from curio_train.errors import UsageError
from curio_train.evaluation.evaluate import evaluate
from curio_train.evaluation.on_plane import shapes_of, standing_on
from curio_train.evaluation.real_scores import Estimate
from curio_train.export.spec import stable_poses_file
from curio_train.geometry import Pose
from curio_train.meshes.stable_poses import hull_points, stable_up
from curio_train.worlds import build
from curio_train.worlds.options import CirclesOptions
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.world import Object
from scipy.spatial.transform import Rotation


def _sides(body: trimesh.Trimesh) -> np.ndarray:
    return stable_up(hull_points(np.asarray(body.vertices)))


def _angles_deg(up: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """From each expected direction to the nearest one found."""
    return np.degrees(np.arccos(np.clip(expected @ up.T, -1, 1).max(axis=1)))


def test_a_brick_stands_on_each_of_its_sides() -> None:
    up = _sides(trimesh.creation.box((0.1, 0.06, 0.04)))
    assert len(up) == 6
    assert _angles_deg(up, np.concatenate([np.eye(3), -np.eye(3)])).max() < 1e-3


def test_a_plate_does_not_stand_on_its_rim_and_a_cone_not_on_its_tip() -> None:
    plate = _sides(trimesh.creation.cylinder(0.1, 0.002))
    assert np.abs(plate[:, 2]).min() > 0.999
    cone = _sides(trimesh.creation.cone(0.03, 0.1))
    assert _angles_deg(cone, np.array([[0, 0, 1.0]])).max() < 1e-3  # its base is at z = 0
    assert cone[:, 2].min() > -0.5


@pytest.mark.parametrize("sections", [16, 64, 1000])
def test_a_cylinder_lies_on_its_side_in_any_turn(sections: int) -> None:
    up = _sides(trimesh.creation.cylinder(0.03, 0.1, sections=sections))
    assert len(up) < 50
    turns = np.radians(np.arange(0, 360, 5))
    assert _angles_deg(up, np.stack([np.cos(turns), np.sin(turns), 0 * turns], axis=1)).max() < 12


def test_flat_bodies_lie_on_either_face_and_rods_without_width_on_none() -> None:
    sheet = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]])
    assert sorted(stable_up(hull_points(sheet)).round(6)[:, 2].tolist()) == [-1, 1]
    assert len(stable_up(sheet[:2])) == len(stable_up(sheet[:1])) == 0


def test_the_hull_reaches_as_far_as_the_mesh() -> None:
    vertices = np.asarray(trimesh.creation.icosphere(4, 0.1).vertices)
    directions = np.random.default_rng(0).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    reach_m = [(points @ directions.T).max(axis=0) for points in (vertices, hull_points(vertices))]
    assert np.abs(reach_m[0] - reach_m[1]).max() < 0.0012


def _world(brick: Object, **changes: object) -> TwoStageWorld:
    return TwoStageWorld("linemod", replace(brick, kind=replace(brick.kind, **changes)))  # type: ignore[arg-type]


def test_a_model_says_how_its_objects_stand_where_they_may_stand_in_any_way(brick: Object) -> None:
    ((file, content),) = stable_poses_file(_world(brick, hull_m=brick.mesh.hull_m)).items()
    assert file == STABLE_POSES_FILE
    (found,) = parse_stable_poses(content, ["brick"], file).objects
    assert len(found.up) == 18
    assert np.abs(np.reshape(found.hull_m, (-1, 3))).max(axis=0) == pytest.approx(np.abs(brick.mesh.vertices_m).max(0))
    assert len(content.splitlines()) == 3  # an object a line
    assert stable_poses_file(_world(brick)) == {}
    assert stable_poses_file(build(CirclesOptions())) == {}


def _read(brick: Object, place_m: list[float], factor: float) -> Estimate:
    """A brick that stands on y = 0.2, whose distance is read wrongly by a factor."""
    rotation = Rotation.from_euler("xy", [90, 30 * place_m[0]], degrees=True).as_matrix()
    lowest_m = (brick.mesh.vertices_m @ rotation.T)[:, 1].max()
    origin_m = np.array([place_m[0], 0.2 - lowest_m, place_m[1]])
    return Estimate(Frame(0, 0, Path("a.png"), np.eye(3), 640, 480), Pose(rotation, factor * origin_m), 0.9, 0.9, 0.1)


def test_estimates_move_until_they_stand_on_the_plane(brick: Object) -> None:
    given = Plane.of([0, 0.2, 1.0], [0, -1, 0])
    shapes = shapes_of(_world(brick, hull_m=brick.mesh.hull_m).objects, CameraPoseFile(Path("views.json"), {})) * 3
    read = [_read(brick, [-0.2, 0.5], 1.0), _read(brick, [0.0, 0.6], 1.01), _read(brick, [0.2, 0.5], 0.99)]
    true_m = [_read(brick, [x, z], 1.0).pose.translation_m for x, z in ((-0.2, 0.5), (0.0, 0.6), (0.2, 0.5))]
    for plane, largest_m in ((given, 0.005), (FIND_PLANE, 0.006)):
        moved = standing_on(read, shapes, plane)
        errors_m = [np.linalg.norm(one.pose.translation_m - true) for one, true in zip(moved, true_m, strict=True)]
        assert max(errors_m) < largest_m
        assert all((one.pose.rotation == was.pose.rotation).all() for one, was in zip(moved, read, strict=True))
    assert standing_on(read[:1], shapes[:1], FIND_PLANE) == read[:1]


def test_a_plane_is_for_real_frames_of_objects_that_may_stand_in_any_way(brick: Object, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="objects that may stand in any way"):
        shapes_of(_world(brick).objects, CameraPoseFile(Path("views.json"), {}))
    with pytest.raises(UsageError, match="one object, brick, stands on any plane"):
        shapes_of(_world(brick, hull_m=brick.mesh.hull_m).objects, FIND_PLANE)
    with pytest.raises(UsageError, match="--plane is for real frames"):
        evaluate(tmp_path, plane=FIND_PLANE, cache=tmp_path)
    with pytest.raises(UsageError, match="not for --refine"):
        evaluate(tmp_path, plane=FIND_PLANE, data=tmp_path, refine=True, cache=tmp_path)


def test_shipped_models_say_how_their_objects_stand() -> None:
    models = sorted((Path(__file__).parents[2] / "models").glob("*/*/model.onnx"))
    assert models
    for path in [model.with_name(STABLE_POSES_FILE) for model in models]:
        names = [one["object"] for one in json.loads(path.read_text())["objects"]]
        assert all(one.up for one in parse_stable_poses(path.read_bytes(), names, str(path)).objects)
