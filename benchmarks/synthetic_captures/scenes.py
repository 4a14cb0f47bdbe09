"""The scenes that stand in for the paper's own captures, whose photographs are not published, and for a user's.

Constants are ours, fixed before any training (paper, section "Real world data" and appendix "Real data experimental
setup", which give no sizes): things of 7 to 12 cm on a table, two cameras 0.75 m away that look down by 40° from
directions 90° apart.

* ``sphere_real``: three spheres, position and colour; cameras on tripods.
* ``bunny``: one bunny-like figure, turned freely; the camera moves on an arc of 90° in ten steps.
* ``shapes``: five to twelve capsules, boxes and cones that stand upright and are turned about their vertical axis.
* ``part``: what a user would bring: one unpainted bracket that lies any way, one camera on a tripod, of more pixels
  than the paper's networks see.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import trimesh
from curio_train.geometry import camera_looking_at
from curio_train.meshes.meshes import Mesh
from curio_train.meshes.shapes import box, capsule, cone, sphere
from scipy.spatial.transform import Rotation

FOCAL_WIDTHS = 300 / 256  # the focal length, in widths of a frame
DISTANCE_M, ELEVATION_DEG = 0.75, 40.0
NUM_STATIONS = 10
_REACH_M = (0.2, 0.14)
_COLOURS = ((0.78, 0.2, 0.16), (0.2, 0.45, 0.75), (0.3, 0.62, 0.3), (0.85, 0.7, 0.2))
_TRIES = 200

NAMES = ("sphere_real", "bunny", "shapes", "part")


@dataclass(frozen=True, eq=False)
class Kind:
    """A mesh that occurs in a scene.

    Attributes:
        name: Of its file.
        mesh: Metres.
        count: The most of them at once.
        fewest: The fewest.
    """

    name: str
    mesh: Mesh
    count: int
    fewest: int


def bunny_like() -> Mesh:
    """A session figure with a head, two ears, feet and a tail; no two sides are alike. About 11 cm, centred."""
    balls = [
        ((0.0, 0.0, 0.0), (0.035, 0.036, 0.04), 0.0),
        ((0.004, 0.04, 0.03), (0.022, 0.021, 0.025), 0.0),
        ((0.014, 0.068, 0.022), (0.007, 0.024, 0.005), -14.0),
        ((-0.009, 0.064, 0.016), (0.007, 0.022, 0.005), 24.0),
        ((0.02, -0.03, 0.028), (0.012, 0.009, 0.02), 0.0),
        ((-0.018, -0.03, 0.03), (0.011, 0.009, 0.022), 0.0),
        ((0.002, -0.012, -0.042), (0.012, 0.012, 0.012), 0.0),
    ]
    parts = []
    for centre, radii, lean in balls:
        ball = trimesh.creation.icosphere(subdivisions=3)
        ball.apply_scale(radii)
        ball.apply_transform(trimesh.transformations.rotation_matrix(np.radians(lean), [0, 0, 1]))
        ball.apply_translation(centre)
        parts.append(ball)
    whole: Any = trimesh.util.concatenate(parts)
    whole.apply_translation(-whole.bounds.mean(axis=0))
    return Mesh(np.asarray(whole.vertices, np.float64), np.asarray(whole.faces, np.int64))


BRACKET_BLOCKS = (
    ((0.08, 0.012, 0.05), (0.0, 0.0, 0.0)),
    ((0.014, 0.05, 0.05), (-0.033, 0.031, 0.0)),
    ((0.03, 0.02, 0.01), (-0.011, 0.016, 0.014)),
)
"""Of the bracket: a base, an upright and a rib, extents and centre of each, metres."""

BRACKET_PIN = ((0.024, 0.016, -0.008), 0.009, 0.03)
"""Of the bracket: centre, radius and height of a cylinder along y, metres."""

BRACKET_MIDDLE = (0.0, 0.025, 0.0)
"""The middle of their bounding box, which is the bracket's origin."""


def bracket() -> Mesh:
    """A machined part of about 10 cm: a base with an upright, a rib on one side and a pin. No two sides are alike."""
    parts = []
    for extents, centre in BRACKET_BLOCKS:
        block = trimesh.creation.box(extents)
        block.apply_translation(centre)
        parts.append(block)
    place, radius, height = BRACKET_PIN
    pin = trimesh.creation.cylinder(radius=radius, height=height, sections=32)
    pin.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    pin.apply_translation(place)
    whole: Any = trimesh.util.concatenate([*parts, pin])
    whole.apply_translation(-whole.bounds.mean(axis=0))
    return Mesh(np.asarray(whole.vertices, np.float64), np.asarray(whole.faces, np.int64))


def kinds(name: str) -> tuple[Kind, ...]:
    """What a scene is made of."""
    if name == "sphere_real":
        return (Kind("sphere", sphere(0.035, 4), 3, 3),)
    if name == "bunny":
        return (Kind("bunny", bunny_like(), 1, 1),)
    if name == "part":
        return (Kind("bracket", bracket(), 1, 1),)
    return (
        Kind("capsule", capsule(0.02, 0.08), 4, 1),
        Kind("box", box((0.05, 0.05, 0.07)), 4, 2),
        Kind("cone", cone(0.03, 0.08), 4, 2),
    )


@dataclass(frozen=True, eq=False)
class Placed:
    """A thing on the table.

    Attributes:
        slot: Number of the thing: kinds in order, each ``count`` times.
        world_from_obj: [4, 4], metres.
    """

    slot: int
    world_from_obj: np.ndarray


def colour(slot: int) -> tuple[float, float, float]:
    """Albedo (sRGB) of a thing, the same in all photographs."""
    return _COLOURS[slot % len(_COLOURS)]


def draw(name: str, random: np.random.Generator) -> list[Placed]:
    """Things at random places where no two touch."""
    placed: list[Placed] = []
    taken: list[tuple[np.ndarray, float]] = []
    first = 0
    for kind in kinds(name):
        for slot in range(first, first + int(random.integers(kind.fewest, kind.count + 1))):
            turn = _turn(name, random)
            vertices = kind.mesh.vertices_m @ turn.T
            radius = float(np.linalg.norm(vertices[:, [0, 2]], axis=1).max())
            place = _free_place(taken, radius, random)
            if place is None:
                continue
            taken.append((place, radius))
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = turn, (place[0], -vertices[:, 1].min(), place[1])
            placed.append(Placed(slot, pose))
        first += kind.count
    return placed


def _turn(name: str, random: np.random.Generator) -> np.ndarray:
    if name in ("bunny", "part"):
        free: np.ndarray = Rotation.random(rng=random).as_matrix()
        return free
    upright: np.ndarray = Rotation.from_rotvec([0, random.uniform(0, 2 * np.pi), 0]).as_matrix()
    return upright


def _free_place(taken: list[tuple[np.ndarray, float]], radius: float, random: np.random.Generator) -> np.ndarray | None:
    for _ in range(_TRIES):
        place = random.uniform(-1, 1, 2) * _REACH_M
        if all(np.linalg.norm(place - other) > radius + reach for other, reach in taken):
            return place
    return None


def frame_size(name: str) -> tuple[int, int]:
    """Width and height of a scene's photographs, pixels."""
    return (640, 480) if name == "part" else (256, 192)


def camera_matrix(name: str) -> np.ndarray:
    """The true K [3, 3] of a scene, of an ideal lens."""
    width, height = frame_size(name)
    focal = FOCAL_WIDTHS * width
    return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])


def cam_from_world(azimuth_deg: float) -> np.ndarray:
    """A camera [4, 4] that looks at the table's middle; azimuth 0 stands towards +z, 90 towards +x."""
    azimuth, elevation = np.radians([azimuth_deg, ELEVATION_DEG])
    level = np.cos(elevation)
    eye = DISTANCE_M * np.array([level * np.sin(azimuth), np.sin(elevation), level * np.cos(azimuth)])
    rotation, shift = camera_looking_at(torch.from_numpy(eye), torch.tensor([0.0, 0.02, 0.0], dtype=torch.float64))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.numpy(), shift.numpy()
    return matrix


def azimuth_deg(name: str, number: int) -> float:
    """Where the first camera of a photograph stands: on its tripod, or at the next step of its arc."""
    return 90.0 * (number % NUM_STATIONS) / (NUM_STATIONS - 1) if name == "bunny" else 0.0


def table_look() -> np.ndarray:
    """A grey, slightly uneven table, [256, 256, 3] uint8 sRGB."""
    random = np.random.default_rng(5)
    coarse = random.normal(0, 1, (16, 16)).repeat(16, 0).repeat(16, 1)
    fine = random.normal(0, 1, (256, 256))
    grey = 150 + 5 * coarse + 4 * fine
    return (grey[..., None] + [6.0, 1.0, -7.0]).clip(0, 255).astype(np.uint8)
