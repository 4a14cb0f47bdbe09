"""A scene written as USD stands where it stood: Pixar's own library reads poses, colours, camera and light back."""

from pathlib import Path

import numpy as np
import pytest
from curio_train.drawing.pictures import SceneContext
from curio_train.drawing.scenes import Placed, Scene
from curio_train.drawing.usd import to_usd
from curio_train.geometry import Pose
from curio_train.meshes.meshes import Mesh
from curio_train.meshes.shapes import box, chair
from pxr import Gf, Usd, UsdGeom, UsdLux
from scipy.spatial.transform import Rotation

K = np.array([[600.0, 0, 300.5], [0, 610.0, 245.0], [0, 0, 1]])
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # with the usual up direction, the root frame is the camera's, turned so


def scene() -> Scene:
    rotations = Rotation.random(2, random_state=4).as_matrix()
    positions = np.array([[0.1, -0.05, 0.7], [-0.2, 0.1, 0.9]])
    objects = (
        Placed("chair", Pose(rotations[0], positions[0]), (0.9, 0.5, 0.2), 1.0),
        Placed("box", Pose(rotations[1], positions[1]), (1.0, 1.0, 1.0), 0.5),
    )
    return Scene("frame", 640, 480, K, objects, np.array([-0.3, -0.8, -1.1]), Path("frame.png"))


@pytest.fixture
def stage(tmp_path: Path) -> Usd.Stage:
    path = tmp_path / "frame.usd"
    path.write_bytes(to_usd(scene(), SceneContext({"chair": chair(0.2), "box": box((0.1, 0.2, 0.3))})))
    return Usd.Stage.Open(str(path))


def matrix_of(stage: Usd.Stage, path: str) -> np.ndarray:
    found = UsdGeom.Xformable(stage.GetPrimAtPath(path)).ComputeLocalToWorldTransform(Usd.TimeCode.Default())
    return np.array(found).T


def test_it_is_in_metres_with_y_up(stage: Usd.Stage) -> None:
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0


def test_every_pose_and_size_is_read_back(stage: Usd.Stage) -> None:
    for number, (item, mesh) in enumerate(zip(scene().objects, (chair(0.2), box((0.1, 0.2, 0.3))), strict=True)):
        path = f"/scene/object_{number:02d}_{item.kind}"
        expected = np.eye(4)
        expected[:3, :3], expected[:3, 3] = item.pose.rotation, item.pose.translation_m
        assert matrix_of(stage, path) == pytest.approx(FLIP @ expected, abs=1e-9)
        shape = UsdGeom.Mesh(stage.GetPrimAtPath(path))
        assert np.ptp(np.array(shape.GetPointsAttr().Get()), axis=0) == pytest.approx(np.ptp(mesh.vertices_m, axis=0))
        assert len(shape.GetFaceVertexCountsAttr().Get()) == len(mesh.faces)
        assert list(shape.GetDisplayOpacityAttr().Get()) == [item.confidence]


def test_the_camera_projects_as_k_does(stage: Usd.Stage) -> None:
    point = scene().objects[0].pose.translation_m
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/scene/camera")).GetCamera(Usd.TimeCode.Default())
    window = camera.frustum.ComputeViewMatrix() * camera.frustum.ComputeProjectionMatrix()
    across, up, _ = window.Transform(Gf.Vec3d(*(FLIP[:3, :3] @ point)))  # -1 to 1 from border to border
    seen = [(across + 1) / 2 * 640 - 0.5, (1 - up) / 2 * 480 - 0.5]
    u, v, w = K @ point
    assert seen == pytest.approx([u / w, v / w], abs=1e-3)


def test_the_lamp_shines_from_the_light(stage: Usd.Stage) -> None:
    towards = FLIP[:3, :3] @ scene().light
    strength = np.linalg.norm(towards)
    assert matrix_of(stage, "/scene/light")[:3, 2] == pytest.approx(towards / strength, abs=1e-9)
    lamp = UsdLux.DistantLight(stage.GetPrimAtPath("/scene/light"))
    assert lamp.GetIntensityAttr().Get() == pytest.approx(strength * np.pi)


def test_a_texture_becomes_colours_of_the_vertices(tmp_path: Path) -> None:
    plain = box((0.1, 0.1, 0.1))
    uv = np.where(plain.vertices_m[:, :2] > 0, 0.75, 0.25)
    picture = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)  # the upper row first
    mesh = Mesh(plain.vertices_m, plain.faces, uv=uv, texture=picture)
    one = Scene("one", 640, 480, K, (Placed("a b", Pose(np.eye(3), np.array([0, 0, 1.0]))),), None)
    path = tmp_path / "one.usd"
    path.write_bytes(to_usd(one, SceneContext({"": mesh})))
    stage = Usd.Stage.Open(str(path))
    shape = UsdGeom.Mesh(stage.GetPrimAtPath("/scene/object_00_a_b"))
    colors = np.array(shape.GetDisplayColorAttr().Get())
    expected = {(0.25, 0.75): (1, 0, 0), (0.75, 0.75): (0, 1, 0), (0.25, 0.25): (0, 0, 1), (0.75, 0.25): (1, 1, 1)}
    for place, color in zip(uv, colors, strict=True):
        assert tuple(color) == expected[tuple(place)]
