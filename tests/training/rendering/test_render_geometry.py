"""The tables behind the renderer: topology, silhouette candidates, bounds in the image."""

import numpy as np
import pytest
import torch
import trimesh
from curio_train.meshes.meshes import Mesh
from curio_train.rendering.bounds import enclosing_polytope, project_bounds
from curio_train.rendering.instances import Instances
from curio_train.rendering.renderer import Renderer
from curio_train.rendering.silhouette_edges import build_edges
from curio_train.rendering.topology import adjacency, smooth_normals
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation


def test_adjacency_of_a_box(meshes) -> None:
    box = meshes["box"]
    found = adjacency(box.vertices_m / 0.05, box.faces)
    assert found.closed
    assert len(found.first) == 18
    assert found.crease.sum() == 12  # the six diagonals lie in flat faces


def test_slivers_are_left_out_and_long_strips_are_not() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-3, 0], [0.5, -1e-4, 0], [0.5, -1.0, 0]])
    found = adjacency(vertices, np.array([[0, 1, 2], [1, 0, 3], [0, 4, 1]]))
    assert found.faces.tolist() == [[0, 1, 2], [0, 4, 1]]
    assert np.allclose(np.linalg.norm(found.face_normals, axis=1), 1)


def test_normals_are_smooth_between_folds_alone(meshes) -> None:
    box, pebble = meshes["box"], meshes["pebble"]
    source, _, normals = smooth_normals(box.vertices_m, adjacency(box.vertices_m / 0.05, box.faces))
    assert len(source) == 24
    assert np.allclose(np.sort(np.abs(normals), axis=1), [0, 0, 1], atol=1e-9)
    source, faces, normals = smooth_normals(pebble.vertices_m, adjacency(pebble.vertices_m / 0.05, pebble.faces))
    assert len(source) == len(pebble.vertices_m)
    expected = trimesh.Trimesh(pebble.vertices_m, pebble.faces, process=False).vertex_normals
    order = np.argsort(source)
    assert (normals[order] * expected).sum(1).min() > 0.99
    assert (pebble.faces == source[faces]).all()


@pytest.mark.parametrize("name", ["pebble", "box", "ring"])
def test_edge_search_finds_every_silhouette_edge(meshes, name: str) -> None:
    """The clusters that are passed over hold none: compared with asking every edge of the mesh."""
    mesh = meshes[name]
    renderer = Renderer([mesh], [0], 64, 64, ambient=0.3)
    setting = renderer.setting
    poses = Rotation.random(16, random_state=0).as_matrix()
    place = np.tile([0.02, -0.01, 0.25], (16, 1))
    values = renderer._pack(
        torch.tensor(poses[:, None], dtype=torch.float32),
        torch.tensor(place[:, None], dtype=torch.float32),
        torch.zeros(16, 3),
        None,
        None,
    )
    rows = Instances(setting.mi, setting.dr, setting.mi.Float(values.reshape(-1)), None)
    row, edge = (found.numpy() for found in setting.outlines.search.find(rows, 16))
    start, end = (setting.outlines.search.edges[name].numpy().reshape(-1, 3)[edge] for name in ("start", "end"))
    found = np.bincount(row[(start != end).any(1)], minlength=16)  # clusters are filled up with edges of length zero
    for i in range(16):
        camera = -poses[i].T @ place[i]
        # Edges of which one face sees the camera and the other doesn't, bent outwards; folds that any face sees.
        assert found[i] == brute_force(mesh, camera)


def brute_force(mesh: Mesh, camera: np.ndarray) -> int:
    """How many edges of a closed mesh are candidates, counted with trimesh."""
    shape = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
    shape.merge_vertices(merge_tex=True)
    first, second = shape.face_adjacency.T
    start = shape.vertices[shape.face_adjacency_edges[:, 0]]
    a, b = (np.einsum("ed,ed->e", shape.face_normals[side], camera - start) for side in (first, second))
    angle, convex = np.degrees(shape.face_adjacency_angles), shape.face_adjacency_convex
    smooth = (angle > 1e-4) & (angle <= 30) & convex & (a * b <= 0)
    fold = (angle > 30) & np.where(convex, np.maximum(a, b) > 0, np.minimum(a, b) > 0)
    return int((smooth | fold).sum())


def test_edge_clusters_hold_their_edges(meshes) -> None:
    root = meshes["root"]
    unit = root.vertices_m / 0.08
    table = build_edges([(unit, adjacency(unit, root.faces))])
    cluster = np.repeat(np.arange(len(table.radius)), len(table.start) // len(table.radius))
    for end in (table.start, table.end):
        assert (np.linalg.norm(end - table.center[cluster], axis=1) <= table.radius[cluster] + 1e-5).all()
    cosine = np.clip((table.normal_a * table.axis[cluster]).sum(1), -1, 1)
    assert (np.arccos(cosine) <= table.angle[cluster] + 1e-5).all()


def test_a_million_faces_are_prepared_in_seconds() -> None:
    """Not timed here: the table of a large mesh is built without a loop over its faces, and passes most of it over."""
    shape = trimesh.creation.icosphere(subdivisions=7)
    vertices = np.asarray(shape.vertices)
    table = build_edges([(vertices, adjacency(vertices, np.asarray(shape.faces)))])
    assert len(table.start) >= 1.5 * len(shape.faces)
    beyond = np.arccos(np.clip(table.axis @ [0, 0, 1.0], -1, 1)) - np.pi / 2
    spread = table.angle + np.arcsin(np.clip(table.radius / 5, 0, 1))
    assert (np.abs(beyond) <= spread).mean() < 0.1


@given(seed=st.integers(0, 10_000), count=st.integers(4, 60), flatness=st.sampled_from([0.0, 1e-9, 0.1, 1.0]))
@settings(max_examples=30, deadline=None)
def test_polytope_encloses_any_cloud(seed: int, count: int, flatness: float) -> None:
    points = np.random.default_rng(seed).normal(size=(count, 3)) * [1, 1, flatness]
    corners = enclosing_polytope(points)
    directions = Rotation.random(64, random_state=seed).as_matrix()[:, 0]
    assert ((corners @ directions.T).max(0) >= (points @ directions.T).max(0)).all()
    assert np.abs(corners).max() < 4 * np.abs(points).max()


def test_bounds_of_what_is_partly_seen() -> None:
    cube = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.1
    places = np.array([[0, 0, 1.0], [0, 0, -1], [0, 0, 0], [9, 0, 1], [np.nan, 0, 1], [0.5, 0, 1]])
    intrinsics = np.tile([100.0, 100, 50, 40], (6, 1))
    bounds = project_bounds(cube + places[:, None], intrinsics, 100, 80)
    assert bounds.rectangle[0].tolist() == [39, 29, 62, 52]  # 0.1 m at 0.9 m is 11.1 pixels to either side
    assert bounds.num_pixels.tolist() == [23 * 23, 0, 8000, 0, 0, bounds.num_pixels[5]]
    assert 0 < bounds.num_pixels[5] < 23 * 23
