"""Parts on a plane that look alike in several poses: no loss and no score tells these apart."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from curio_train.config import NetworkConfig
from curio_train.errors import UsageError
from curio_train.evaluation.scores import accuracy, scene_errors, scene_scores
from curio_train.geometry import camera_looking_at, rotation_6d_from_matrix
from curio_train.networks.grid import per_cell
from curio_train.scene_code import ROTATION_6D, TRANSLATION, YAW, SceneCode
from curio_train.worlds import build
from curio_train.worlds.options import CaptureOptions
from curio_train.worlds.tabletop.world import TabletopWorld
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT = 96, 72
UP, ACROSS = (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)  # of frames with y up; z of the files is up


def prism(sides: int, radius_mm: float) -> trimesh.Trimesh:
    """Upright, and turned so that no axis of the file is one of its sides'."""
    angles = 0.3 + 2 * np.pi * np.arange(sides) / sides
    ring = radius_mm * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    ends = [np.column_stack([ring, np.full(sides, height)]) for height in (0.0, 30.0)]
    return trimesh.Trimesh(np.concatenate(ends)).convex_hull


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Meshes, in millimetres, and photographs of a grey plane with something dark on it."""
    root = tmp_path_factory.mktemp("alike")
    rod = trimesh.creation.cylinder(8, 70, sections=48)
    rod.export(root / "rod.stl")
    rod.visual.vertex_colors = np.array([200, 30, 30, 255], np.uint8)
    rod.export(root / "painted.ply")
    prism(6, 35).export(root / "nut.stl")
    prism(3, 40).export(root / "triangle.stl")
    trimesh.creation.cone(20, 50, sections=48).export(root / "cone.stl")
    trimesh.creation.icosphere(3, 20).export(root / "ball.stl")
    matrix = [[110.0, 0, 47.5], [0, 110, 35.5], [0, 0, 1]]
    (root / "camera.json").write_text(json.dumps({"camera_matrix": matrix, "width": WIDTH, "height": HEIGHT}))
    camera = np.eye(4)
    camera[:3, :3], camera[:3, 3] = camera_looking_at(torch.tensor([0.0, 0.5, 0.55]).double(), torch.zeros(3).double())
    (root / "views.json").write_text(json.dumps({"empty.png": {"cam_from_world": camera.tolist()}}))
    empty = np.full((HEIGHT, WIDTH, 3), 130, np.uint8)
    cv2.imwrite(str(root / "empty.png"), empty)
    (root / "photos").mkdir()
    for number in range(4):
        photo = empty.copy()
        photo[20:60, 10 + 15 * number : 40 + 15 * number] = 40
        cv2.imwrite(str(root / "photos" / f"{number}.png"), photo)
    return root


def world_of(folder: Path, *meshes: str, lying: bool = False, count: int = 1, centered: bool = True) -> TabletopWorld:
    found = build(
        CaptureOptions(
            mesh=tuple(folder / mesh for mesh in meshes),
            camera=folder / "camera.json",
            photos=folder / "photos",
            mesh_unit="mm",
            background=folder / "empty.png",
            plane=folder / "views.json",
            counts=(str(count),) * len(meshes),
            lying=lying,
            centered=centered,
        )
    )
    assert isinstance(found, TabletopWorld)
    return found


def about(axis: tuple[float, ...], degrees: float) -> torch.Tensor:
    return torch.from_numpy(Rotation.from_rotvec(np.radians(degrees) * np.array(axis)).as_matrix()).float()


def turned(world: TabletopWorld, code: SceneCode, turn: torch.Tensor) -> dict[str, torch.Tensor]:
    """The same scene with each part turned in its own frame."""
    return {**code, **world.orientation.entries(world.orientation.rotation(code) @ turn)}


TURNS = [
    pytest.param("rod.stl", about(UP, 70), 0, id="a rod about its axis"),
    pytest.param("rod.stl", about(ACROSS, 180) @ about(UP, 33), 0, id="a rod the other way round"),
    pytest.param("rod.stl", about(UP, 50) @ about(ACROSS, 20), 20, id="a rod that points elsewhere"),
    pytest.param("cone.stl", about(ACROSS, 180), 180, id="a cone the other way round"),
    pytest.param("ball.stl", about(ACROSS, 77), 0, id="a ball"),
    pytest.param("painted.ply", about(UP, 70), 70, id="a painted rod about its axis"),
]


@pytest.mark.parametrize(("mesh", "turn", "degrees"), TURNS)
def test_lying_parts_are_scored_by_how_they_look(folder: Path, mesh: str, turn: torch.Tensor, degrees: float) -> None:
    world = world_of(folder, mesh, lying=True, count=2)
    true = world.sample(3, (0,))
    predicted = {name: value.flip(1) if value.ndim == 3 else value for name, value in turned(world, true, turn).items()}
    errors = scene_errors(world, predicted, true)
    assert errors["rotation_deg"].tolist() == pytest.approx([degrees] * 6, abs=0.2)
    assert accuracy(world, predicted, true) == (degrees < 10)
    loss = float(world.code_loss(predicted, true))
    assert loss == pytest.approx(float(errors["scene_error"].mean()))
    assert (loss > 0.1) == (degrees > 10)
    assert loss > 0.1 or loss < 0.01


@pytest.mark.parametrize(("mesh", "turn", "degrees"), TURNS)
def test_cells_are_taught_by_how_lying_parts_look(folder: Path, mesh: str, turn: torch.Tensor, degrees: float) -> None:
    world = world_of(folder, mesh, lying=True)
    true = world.sample(1, (0,))
    network = world.network(NetworkConfig(reading="cells"))
    with torch.no_grad():
        read = network(world.render(true))

    def loss(rotation_6d: torch.Tensor) -> float:
        of_cells = rotation_6d.expand_as(read[per_cell(ROTATION_6D)])
        return float(world.code_loss({**read, per_cell(ROTATION_6D): of_cells}, true))

    least = loss(true[ROTATION_6D][:, None])
    assert (loss(turned(world, true, turn)[ROTATION_6D][:, None]) > least + 0.1) == (degrees > 10)


def test_all_cells_learn_one_of_the_rotations_that_look_alike(folder: Path) -> None:
    """Slots are filled with means over cells: if each learned the rotation nearest to its own, these would be none."""
    world = world_of(folder, "rod.stl", lying=True)
    true = world.sample(1, (0,))
    network = world.network(NetworkConfig(reading="cells"))
    with torch.no_grad():
        read = network(world.render(true))
    rotation, name = world.orientation.rotation(true)[0, 0], per_cell(ROTATION_6D)
    both = [rotation_6d_from_matrix(rotation @ turn).expand_as(read[name]) for turn in (about(UP, 0), about(UP, 180))]
    mixed = both[0].clone()
    mixed[:, :, ::2] = both[1][:, :, ::2]  # every other column of cells
    losses = [float(world.code_loss({**read, name: of_cells}, true)) for of_cells in (*both, mixed)]
    assert losses[1] == pytest.approx(losses[0], abs=0.01)
    assert losses[2] > losses[0] + 0.1


@pytest.mark.parametrize(("mesh", "order"), [("nut.stl", 6), ("triangle.stl", 3)])
def test_errors_of_folded_yaws_are_degrees_of_the_part(folder: Path, mesh: str, order: int) -> None:
    world = world_of(folder, mesh)
    assert world.yaw_folds.tolist() == [order]
    true = world.sample(5, (0,))
    for turn_deg, expected in ((8, 8), (180 / order, 180 / order), (360 / order, 0), (360 / order - 3, 3)):
        predicted = turned(world, true, about(UP, turn_deg))
        errors = scene_errors(world, predicted, true)["rotation_deg"]
        assert errors.tolist() == pytest.approx([expected] * 5, abs=0.01)
        assert accuracy(world, predicted, true) == (expected < 10)


def test_the_yaw_of_a_round_part_is_no_error(folder: Path) -> None:
    world = world_of(folder, "cone.stl", "nut.stl")
    true = world.sample(2, (0,))
    predicted = dict(true) | {YAW: true[YAW].clone()}
    predicted[YAW][:, 0] = torch.tensor([0.0, 1.0])
    scores = scene_scores(world, predicted, true)
    assert scores["rotation_deg"] == pytest.approx(0, abs=1e-3)
    assert accuracy(world, predicted, true) == 1


@pytest.mark.parametrize(("mesh", "lying"), [("triangle.stl", False), ("triangle.stl", True), ("nut.stl", True)])
def test_codes_have_the_position_of_a_point_that_symmetries_leave(folder: Path, mesh: str, lying: bool) -> None:
    """The middle of a triangle's box is none."""
    world = world_of(folder, mesh, lying=lying)
    (part,) = world.parts
    motions = [motion for motion in part.info.symmetries if lying or motion[1, 1] > 0.99]
    assert motions
    for motion in motions:
        assert np.linalg.norm(motion[:3, 3]) < 0.01 * part.info.diameter_m
    of_box = world_of(folder, mesh, lying=lying, centered=False).parts[0].file_from_own.translation_m
    off = np.linalg.norm(of_box - part.file_from_own.translation_m)
    assert (off > 5e-3) == (mesh == "triangle.stl")


def test_earlier_runs_are_gone_on_with_as_they_were(folder: Path) -> None:
    """Their positions are of the middle of the box, which the symmetries of a triangle move; image sets are kept."""
    assert not world_of(folder, "triangle.stl", lying=True, centered=False).slot_infos[0].is_symmetric
    assert world_of(folder, "rod.stl", lying=True, centered=False).slot_infos[0].is_symmetric
    for mesh, is_drawn_anew in (("triangle.stl", True), ("nut.stl", False), ("rod.stl", False)):
        recipes = [world_of(folder, mesh, lying=True, centered=centered).recipe for centered in (False, True)]
        assert (recipes[0] != recipes[1]) == is_drawn_anew, mesh


def test_a_painted_part_has_no_symmetry_in_its_model(folder: Path) -> None:
    (painted,), (rod,) = (world_of(folder, name, lying=True).objects for name in ("painted.ply", "rod.stl"))
    assert not painted.info.is_symmetric
    assert rod.info.is_symmetric


def test_both_ends_of_a_folded_yaw_are_one_image(folder: Path) -> None:
    world = world_of(folder, "triangle.stl")
    code = world.sample(4, (0,))
    angle = np.radians(179.9)
    yaws = (torch.tensor([np.cos(angle), sign * np.sin(angle)]).float() for sign in (1, -1))
    ends = [world.render({**code, YAW: yaw.expand_as(code[YAW])}) for yaw in yaws]
    beside = world.render({**code, TRANSLATION: code[TRANSLATION] + torch.tensor([0.005, 0.0, 0.0])})
    assert (ends[0] - ends[1]).abs().mean() < 0.2 * (beside - world.render(code)).abs().mean()


def test_more_parts_than_find_room_are_refused(folder: Path) -> None:
    assert world_of(folder, "nut.stl", count=9).layout.num_slots == 9
    with pytest.raises(UsageError, match="--counts 2000-2000: so many parts do not fit"):
        world_of(folder, "nut.stl", count=2000)
