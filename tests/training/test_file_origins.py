"""CAD files have their origin anywhere: networks read where the middle is, and answers are of the file's origin."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from curio_proto.v1.detector_pb2 import Detection
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.models.object_frames import center_of
from curio_train.config import RunConfig
from curio_train.export.graph import Graph
from curio_train.export.spec import model_spec
from curio_train.geometry import Pose, matrix_from_rotation_6d, rotation_6d_from_matrix
from curio_train.learning.runs.configuration import from_json, to_json
from curio_train.meshes.meshes import load_mesh
from curio_train.meshes.symmetries import find_symmetries
from curio_train.refinement.detections import DetectionRefiner, NamedMesh
from curio_train.scene_code import CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION
from curio_train.viewing.pages import _context
from curio_train.worlds import build
from curio_train.worlds.options import CaptureOptions
from curio_train.worlds.several_objects.world import SeveralObjectsWorld
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

MOVED_MM = np.array([300.0, 40.0, -25.0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Parts in millimetres: a lump as it is and with its origin far away, a plate with it on an edge, a tube beside."""
    root = tmp_path_factory.mktemp("parts")
    lump = trimesh.util.concatenate([trimesh.creation.box((80, 40, 20)), trimesh.creation.box((30, 20, 90))])
    lump.vertices += np.array([10, 0, 0]) * (lump.vertices[:, 2:] > 30)
    lump.export(root / "lump.stl")
    lump.apply_translation(MOVED_MM)
    lump.export(root / "moved.stl")
    plate = trimesh.creation.box((100, 60, 20))
    plate.apply_translation([50, 0, 0])
    plate.export(root / "plate.stl")
    tube = trimesh.creation.cylinder(20, 80)
    tube.apply_translation([30, 0, 0])
    tube.export(root / "tube.stl")
    wedge = trimesh.creation.cylinder(30, 60, sections=3)
    wedge.apply_translation([0, 5, 0])
    wedge.export(root / "wedge.stl")
    camera = {"camera_matrix": [[180, 0, 79.5], [0, 180, 59.5], [0, 0, 1]], "width": 160, "height": 120}
    (root / "camera.json").write_text(json.dumps(camera))
    return root


def options(folder: Path, *names: str) -> CaptureOptions:
    meshes = tuple(folder / f"{name}.stl" for name in names)
    return CaptureOptions(meshes, folder / "camera.json", folder, mesh_unit="mm")


@pytest.fixture(scope="module")
def worlds(folder: Path) -> tuple[TwoStageWorld, TwoStageWorld]:
    """Of the lump, and of the same with its origin elsewhere."""
    one, moved = (build(options(folder, name)) for name in ("lump", "moved"))
    assert isinstance(one, TwoStageWorld)
    assert isinstance(moved, TwoStageWorld)
    return one, moved


class Reads(nn.Module):
    """A network that reads the same scene in every image."""

    def __init__(self, code: dict[str, Tensor]) -> None:
        super().__init__()
        self._code = code

    def forward(self, image: Tensor, slots: Tensor | None = None) -> dict[str, Tensor]:
        """Its scene code, of the wanted slots alone."""
        if slots is None:
            return self._code
        return {name: values[:, slots] if values.ndim == 3 else values for name, values in self._code.items()}


def test_the_middle_is_learned_and_the_files_origin_answered(worlds: tuple[TwoStageWorld, TwoStageWorld]) -> None:
    one, moved = worlds
    code = one.sample(3, (1,))
    assert torch.allclose(code[TRANSLATION], moved.sample(3, (1,))[TRANSLATION])
    assert (one.render(code) - moved.render(code)).abs().mean() < 1e-4, "they look the same"
    image = torch.zeros(3, 120, 160, 3, dtype=torch.uint8)
    seen = []
    for world in worlds:
        outputs = Graph(Reads(code), world).outputs(image)
        poses = Pose(outputs["rotation"][:, 0], outputs[TRANSLATION][:, 0])
        vertices = torch.from_numpy(world.object.mesh_of_file.vertices_m).float()
        seen.append(torch.stack([pose.apply(vertices) for pose in map(Pose, *poses)]))
        back = world.outputs.to_code(outputs)
        assert torch.allclose(back[TRANSLATION], code[TRANSLATION], atol=1e-6)
    assert torch.allclose(*seen, atol=1e-6), "every vertex of either file is at the same place"
    assert outputs[TRANSLATION].sub(code[TRANSLATION]).norm(dim=-1).min() > 0.25


def test_the_specification_is_in_the_files_frame(folder: Path, worlds: tuple[TwoStageWorld, TwoStageWorld]) -> None:
    one, moved = (model_spec(world, "lump").objects[0] for world in worlds)
    np.testing.assert_allclose(center_of(moved) - center_of(one), MOVED_MM / 1000, atol=1e-5)
    for name, kind in (("lump", one), ("moved", moved)):
        mesh = load_mesh(folder / f"{name}.stl", "mm")
        np.testing.assert_allclose(np.reshape(kind.box_corners_m, (8, 3)), mesh.box_corners_m, atol=1e-6)
        assert kind.mesh_sha256 == mesh.sha256
        middle = mesh.box_corners_m.mean(axis=0)
        assert np.linalg.norm(center_of(kind) - middle) < 0.1 * mesh.diameter_m


@pytest.mark.parametrize(
    ("name", "expected_mm"), [("plate", (50, 0, 0)), ("tube", (30, 0, 0)), ("wedge", (0, 5, 0)), ("lump", None)]
)
def test_symmetries_leave_the_middle_in_its_place(
    folder: Path, name: str, expected_mm: tuple[float, float, float] | None
) -> None:
    """Of the wedge, whose turns by 120 degrees do not leave the middle of its box."""
    world = build(options(folder, name))
    kind = world.objects[0]
    center_m = np.array(kind.center_m)
    if expected_mm is not None:
        assert len(kind.symmetries) + len(kind.symmetry_axes) > 0
        np.testing.assert_allclose(center_m * 1000, expected_mm, atol=0.02 * kind.diameter_m * 1000)
    for matrix in kind.symmetries:
        np.testing.assert_allclose(matrix[:3, :3] @ center_m + matrix[:3, 3], center_m, atol=0.02 * kind.diameter_m)


def test_a_shape_without_symmetries_has_its_middle_where_it_is_asked_for(folder: Path) -> None:
    found = find_symmetries(load_mesh(folder / "lump.stl", "mm"))
    lopsided = replace(found, discrete=(), continuous=())
    np.testing.assert_allclose(lopsided.point_left(np.array([0.1, 0.2, 0.3])), [0.1, 0.2, 0.3])


def test_how_far_an_origin_is_does_not_count_in_comparisons(worlds: tuple[TwoStageWorld, TwoStageWorld]) -> None:
    """A rotation that differs by rounding moves the position of a distant origin, and of the middle not."""
    _, moved = worlds
    code = moved.sample(2, (1,))
    turn = torch.from_numpy(Rotation.from_rotvec([0, 0, 2e-4]).as_matrix()).float()
    rotation = matrix_from_rotation_6d(code[ROTATION_6D]) @ turn
    other = {**code, ROTATION_6D: rotation_6d_from_matrix(rotation)}
    graph = Graph(Reads(code), moved)
    one, turned = graph.outputs(torch.zeros(2, 120, 160, 3, dtype=torch.uint8)), moved.outputs.from_code(other)
    assert (one[TRANSLATION] - turned[TRANSLATION]).abs().max() > 3e-5
    assert torch.allclose(graph.judged(one)[TRANSLATION], graph.judged(turned)[TRANSLATION], atol=1e-6)


def test_of_several_parts_each_has_its_own_middle(folder: Path) -> None:
    world = build(options(folder, "lump", "moved", "plate"))
    assert isinstance(world, SeveralObjectsWorld)
    code = world.sample(2, (1,))
    code[CONFIDENCE][:] = 1
    graph, image = Graph(Reads(code), world), torch.zeros(2, 120, 160, 3, dtype=torch.uint8)
    every, part = graph(image), graph(image, torch.tensor([2, 1]))
    for whole, rows in zip(every, part, strict=True):
        assert torch.equal(rows, whole[:, [2, 1]] if whole.shape[:2] == (2, 3) and rows.shape[1] == 2 else whole)
    centers = [center_of(kind) for kind in model_spec(world, "parts").objects]
    assert len({tuple(np.round(center, 3)) for center in centers}) == 3


def test_networks_of_older_versions_are_of_the_files_origin(folder: Path) -> None:
    stored = to_json(RunConfig(options(folder, "plate"), method="sleep"))
    assert from_json(stored).world == options(folder, "plate")
    del stored["world"]["centered"]
    older = build(from_json(stored).world)
    assert older.objects[0].center_m == (0, 0, 0)
    assert "center_m" not in [field.name for field, _ in model_spec(older, "plate").objects[0].ListFields()]


def test_meshes_are_drawn_where_their_poses_are(worlds: tuple[TwoStageWorld, TwoStageWorld]) -> None:
    """Pages of ``curio-view`` place the file's mesh with the answers of the file's origin."""
    _, moved = worlds
    shown = _context(Path("run"), moved).mesh("moved")
    np.testing.assert_allclose(shown.vertices_m.mean(axis=0), moved.object.mesh_of_file.vertices_m.mean(axis=0))
    assert shown.vertices_m[:, 0].min() > 0.2


def test_poses_are_refined_alike(worlds: tuple[TwoStageWorld, TwoStageWorld]) -> None:
    """From a pose that is turned by 8 degrees about the middle."""
    one, _ = worlds
    code = one.sample(1, (3,))
    code[TRANSLATION] = torch.tensor([[[0.01, 0.02, 0.4]]])
    pixels = (one.render(code)[0].clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()
    true = matrix_from_rotation_6d(code[ROTATION_6D][0, 0]).numpy().astype(float)
    rotation = Rotation.from_rotvec(np.radians([0, 4.8, 6.4])).as_matrix() @ true
    for world in worlds:
        spec, mesh = model_spec(world, "lump"), world.object.mesh_of_file
        refiner = DetectionRefiner(spec, {world.object.kind.name: NamedMesh("mesh", mesh)})
        detection = Detection(object=world.object.kind.name, rotation=rotation.ravel(), rotation_6d=[0.0] * 6)
        detection.translation_m[:] = code[TRANSLATION][0, 0].numpy() - rotation @ world.object.kind.center_m
        refiner(pixels, PinholeCamera(np.asarray(world.camera.matrix)), [detection], code[LIGHT][0].tolist())
        assert refiner.num_refined == 1
        found = np.reshape(detection.rotation, (3, 3))
        assert np.degrees(Rotation.from_matrix(found @ true.T).magnitude()) < 4
        middle_m = detection.translation_m + found @ world.object.kind.center_m
        np.testing.assert_allclose(middle_m, code[TRANSLATION][0, 0], atol=0.006)
