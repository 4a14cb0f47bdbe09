"""Generated meshes: closed, facing outwards, of the size asked for, and painted so that yaw can be seen."""

import numpy as np
import pytest
import trimesh
from curio_train.meshes.letters import extruded, letter, triangles
from curio_train.meshes.meshes import Mesh
from curio_train.meshes.shapes import box, capsule, chair, cone, painted, sphere, standing
from matplotlib.path import Path

SHAPES = {
    "sphere": sphere(0.2),
    "box": box((0.3, 0.2, 0.1)),
    "cone": cone(0.2, 0.5),
    "capsule": capsule(0.1, 0.5),
    **{name: letter(name, 0.4, 0.1) for name in "WXYZ"},
}


def as_trimesh(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_are_closed_centred_and_face_outwards(name: str) -> None:
    mesh = SHAPES[name]
    solid = as_trimesh(mesh)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.volume > 0
    assert mesh.vertices_m.min(0) == pytest.approx(-mesh.vertices_m.max(0), abs=2e-3)


@pytest.mark.parametrize("name", "WXYZ")
def test_letters_fill_their_outline_and_nothing_else(name: str) -> None:
    mesh = letter(name, 0.4, 0.1)
    assert np.ptp(mesh.vertices_m, axis=0)[1:] == pytest.approx([0.4, 0.1])
    outline = mesh.vertices_m[: len(mesh.vertices_m) // 2, :2]
    x, y = outline.T
    area = abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2  # shoelace formula
    assert as_trimesh(mesh).volume == pytest.approx(area * 0.1)


def test_letters_look_like_themselves() -> None:
    def is_inside(name: str, x: float, y: float) -> bool:
        mesh = letter(name, 1.0, 0.2)
        front = mesh.faces[(mesh.vertices_m[mesh.faces][..., 2] > 0).all(axis=1)]
        return any(Path(corners).contains_point((x, y)) for corners in mesh.vertices_m[front][..., :2])

    assert [is_inside(name, 0.01, 0.0) for name in "WXYZ"] == [True, True, True, True]
    assert [is_inside(name, 0.0, 0.45) for name in "WXYZ"] == [False, False, False, True]
    assert [is_inside(name, 0.0, -0.45) for name in "WXYZ"] == [False, False, True, True]
    assert [is_inside(name, 0.3, 0.45) for name in "WXYZ"] == [False, True, True, True]
    assert [is_inside(name, 0.25, -0.45) for name in "WXYZ"] == [True, True, False, True]
    assert [is_inside("Z", x, 0.2) for x in (0.25, -0.25)] == [True, False]  # the stroke of Z rises to the right


def test_an_outline_the_wrong_way_round_is_refused() -> None:
    square = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    assert as_trimesh(extruded(square[::-1], 0.5)).volume == pytest.approx(0.5)
    with pytest.raises(ValueError, match="clockwise"):
        triangles(square)
    with pytest.raises(ValueError, match="letter 'A'"):
        letter("A", 1, 1)


def test_a_chair_stands_on_four_legs_and_leans_back() -> None:
    mesh = standing(chair(0.6))
    assert mesh.vertices_m[:, 1].min() == 0
    assert np.ptp(mesh.vertices_m, axis=0) == pytest.approx([0.3, 0.6, 0.3])
    parts = as_trimesh(mesh).split()
    assert len(parts) == 6
    assert all(part.is_watertight and part.volume > 0 for part in parts)
    assert sum(part.vertices[:, 1].min() < 1e-9 for part in parts) == 4
    back = max(parts, key=lambda part: part.vertices[:, 1].max())
    assert back.vertices[:, 2].max() < 0


def test_paint_fades_from_front_to_back_and_has_its_own_name() -> None:
    plain = cone(0.2, 0.5)
    mesh = painted(plain, 0.4)
    front, back = mesh.vertices_m[:, 2].argmax(), mesh.vertices_m[:, 2].argmin()
    assert mesh.vertex_colors_srgb[front].tolist() == [1, 1, 1]
    assert mesh.vertex_colors_srgb[back] == pytest.approx([0.4, 0.4, 0.4])
    assert len({plain.sha256, mesh.sha256, painted(plain, 0.5).sha256, standing(plain).sha256}) == 4
