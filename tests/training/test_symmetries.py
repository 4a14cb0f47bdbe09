"""Symmetries found from shapes whose groups are known, and BOP's annotation of LM-O."""

import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from curio_train.data.bop import BopDataset
from curio_train.geometry import Pose
from curio_train.meshes import shapes
from curio_train.meshes.meshes import Mesh
from curio_train.meshes.symmetries import find_symmetries
from curio_train.worlds.tabletop.files import yaw_fold
from scipy.spatial.transform import Rotation

LARGEST_DISAGREEMENT = 0.03
"""Of the diameter, between where BOP's motion and ours carry any point of the object."""


def prism(sides: int, height: float) -> Mesh:
    shape = trimesh.creation.cylinder(0.03, height, sections=sides)
    return Mesh(np.asarray(shape.vertices, np.float64), np.asarray(shape.faces, np.int64))


def cup() -> Mesh:
    """A cylinder with a handle nearer to its top."""
    parts = [trimesh.creation.cylinder(0.04, 0.1, sections=48), trimesh.creation.box((0.03, 0.012, 0.05))]
    parts[1].apply_translation([0.052, 0.0, 0.015])
    whole = trimesh.util.concatenate(parts)
    return Mesh(np.asarray(whole.vertices, np.float64), np.asarray(whole.faces, np.int64))


@pytest.mark.parametrize(
    ("mesh", "num_discrete", "num_continuous"),
    [
        pytest.param(shapes.box((0.03, 0.05, 0.08)), 3, 0, id="box"),
        pytest.param(shapes.box((0.1, 0.092, 0.04)), 3, 0, id="almost square box"),
        pytest.param(shapes.box((0.034, 0.078, 0.071)), 3, 0, id="box with two almost equal moments"),
        pytest.param(shapes.box((0.1, 0.1, 0.04)), 7, 0, id="square box"),
        pytest.param(prism(4, 0.09), 7, 0, id="square prism"),
        pytest.param(prism(6, 0.09), 11, 0, id="hexagonal prism"),
        pytest.param(shapes.cone(0.03, 0.08), 0, 1, id="cone"),
        pytest.param(shapes.capsule(0.02, 0.09), 1, 1, id="capsule"),
        pytest.param(shapes.sphere(0.05), 0, 2, id="sphere"),
        pytest.param(shapes.chair(0.4), 0, 0, id="chair"),
        pytest.param(cup(), 0, 0, id="cup, which only its handle tells from a cylinder"),
    ],
)
def test_groups_of_known_shapes(mesh: Mesh, num_discrete: int, num_continuous: int) -> None:
    found = find_symmetries(mesh)
    assert (len(found.discrete), len(found.continuous)) == (num_discrete, num_continuous)


def test_flips_of_a_box_leave_its_middle() -> None:
    for motion in find_symmetries(shapes.box((0.1, 0.1, 0.04))).discrete:
        assert np.linalg.norm(motion[:3, 3]) < 1e-6


def test_motions_are_of_the_object_frame_wherever_its_origin_lies() -> None:
    offset = np.array([0.2, -0.1, 0.05])
    box = shapes.box((0.03, 0.05, 0.08))
    turned = Rotation.from_euler("xyz", [20, 30, 40], degrees=True).as_matrix()
    moved = Mesh(Pose(turned, offset).apply(box.vertices_m), box.faces)
    for motion in find_symmetries(moved).discrete:
        carried = Pose.from_matrix(motion).apply(moved.vertices_m)
        distances = np.linalg.norm(carried[:, None] - moved.vertices_m[None], axis=2).min(axis=1)
        assert distances.max() < 0.01 * box.diameter_m


@pytest.mark.parametrize("mesh", [shapes.box((0.03, 0.05, 0.08)), shapes.cone(0.03, 0.08)], ids=["box", "cone"])
def test_motions_of_another_frame(mesh: Mesh) -> None:
    turned = Rotation.from_euler("xyz", [20, 30, 40], degrees=True).as_matrix()
    moved = Pose(turned, np.array([0.2, -0.1, 0.05]))
    found = find_symmetries(mesh)
    there, points_m = found.in_frame(*moved), mesh.vertices_m
    assert (len(there.discrete), len(there.continuous)) == (len(found.discrete), len(found.continuous))
    for own, motion in zip(found.discrete, there.discrete, strict=True):
        before = moved.apply(Pose.from_matrix(own).apply(points_m))
        assert np.allclose(Pose.from_matrix(motion).apply(moved.apply(points_m)), before, atol=1e-12)
    for (own_axis, own_m), (axis, point_m) in zip(found.continuous, there.continuous, strict=True):
        assert np.allclose(moved.apply(own_m + own_axis), point_m + axis)
        assert np.allclose(moved.apply(own_m), point_m)


def test_bop_fields_are_row_major_millimetres() -> None:
    fields = find_symmetries(shapes.capsule(0.02, 0.09)).as_bop()
    (flip,), (axis,) = fields["symmetries_discrete"], fields["symmetries_continuous"]
    assert np.array(flip).shape == (16,)
    assert np.allclose(np.array(flip[12:]), [0, 0, 0, 1])
    assert abs(flip[5]) == pytest.approx(1, abs=0.01), "a flip turns the axis, y, to -y"
    assert np.abs(axis["axis"]) == pytest.approx([0, 1, 0], abs=0.03)
    assert np.abs(axis["offset"]).max() < 2, "millimetres from the origin, which is its middle"


@pytest.mark.skipif("CURIO_DATA" not in os.environ, reason="CURIO_DATA names no folder with LM-O")
@pytest.mark.parametrize("name", ["ape", "can", "cat", "driller", "duck", "eggbox", "glue", "holepuncher"])
def test_agrees_with_bop(name: str) -> None:
    dataset = BopDataset(Path(os.environ["CURIO_DATA"]) / "lmo")
    mesh, annotated = dataset.mesh(name), dataset.model_info(name).symmetries
    found = find_symmetries(mesh)
    assert not found.continuous
    assert len(found.discrete) == len(annotated)
    for ours, theirs in zip(found.discrete, annotated, strict=True):
        ends = [Pose.from_matrix(motion).apply(mesh.vertices_m) for motion in (ours, theirs)]
        apart = np.linalg.norm(ends[0] - ends[1], axis=1).max() / mesh.diameter_m
        assert apart < LARGEST_DISAGREEMENT, f"{name}: {apart:.3f} diameters apart"


@pytest.mark.parametrize(("up", "fold"), [((0, 0, 1), 0), ((1, 0, 0), 2), ((0, 1, 0), 2)])
def test_a_lying_rod_looks_the_same_after_half_a_turn_about_the_vertical(up: tuple[int, ...], fold: int) -> None:
    """Its flip and any turn about its axis make that half turn; a cone has no flip."""
    for shape, expected in ((trimesh.creation.cylinder(0.01, 0.08), fold), (trimesh.creation.cone(0.02, 0.08), 1)):
        found = find_symmetries(Mesh(np.asarray(shape.vertices), np.asarray(shape.faces)))
        assert yaw_fold(found, np.array(up, float)) == (0 if up == (0, 0, 1) else expected)
