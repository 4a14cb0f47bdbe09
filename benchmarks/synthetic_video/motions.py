"""Paths of objects through the view of a camera, frame by frame.

Every path is a function of the number of frames and a random generator, and gives cam_from_obj poses [frames, 4, 4] in
metres, OpenCV's camera frame. Nothing here renders.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

FRAMES_PER_SECOND = 30.0
Path6 = Float[np.ndarray, "frames 4 4"]

_TILT = Rotation.from_euler("x", 110, degrees=True)  # z up in the object's frame: seen from above


def at_rest(num: int, random: np.random.Generator, depth_m: float = 0.8) -> Path6:
    """An object that stands still somewhere near the middle."""
    position = np.array([*random.uniform(-0.1, 0.1, 2), depth_m])
    return poses(np.repeat(position[None], num, axis=0), _viewpoint(random), num)


def carried_past(num: int, random: np.random.Generator, speed_m_s: float = 0.5, depth_m: float = 0.9) -> Path6:
    """An object carried across the view at a steady speed, turning slowly; in its middle halfway through."""
    angle = random.uniform(-0.3, 0.3)
    direction = np.array([np.cos(angle), np.sin(angle), 0.0]) * random.choice([-1, 1])
    seconds = (np.arange(num) - num / 2)[:, None] / FRAMES_PER_SECOND
    position = np.array([0, 0, depth_m]) + seconds * speed_m_s * direction
    turned = Rotation.from_rotvec(seconds * random.uniform(-0.4, 0.4, 3))
    return poses(position, turned * _viewpoint(random), num)


def wandering(num: int, random: np.random.Generator, depth_m: float = 0.8) -> Path6:
    """An object moved about smoothly within a hand's width."""
    seconds = np.arange(num)[:, None] / FRAMES_PER_SECOND
    phases, rates = random.uniform(0, 2 * np.pi, 3), random.uniform(1.0, 2.0, 3)
    offset = np.array([0.06, 0.05, 0.04]) * np.sin(seconds * rates + phases)
    turned = Rotation.from_rotvec(0.3 * np.sin(seconds * rates + phases))
    return poses(offset + np.array([0, 0, depth_m]), turned * _viewpoint(random), num)


def side_by_side(num: int, random: np.random.Generator, depth_m: float = 0.9) -> tuple[Path6, Path6]:
    """Two objects that come near each other, never nearer than 0.17 m, and part again."""
    towards = np.sin(np.pi * np.arange(num) / (num - 1))[:, None] ** 2
    apart = 0.17 + 0.14 * (1 - towards)
    lift = 0.05 * np.sin(np.arange(num)[:, None] / 12 + random.uniform(0, 6))
    left = np.concatenate([-apart / 2, lift, np.full((num, 1), depth_m)], axis=1)
    right = np.concatenate([apart / 2, -lift, np.full((num, 1), depth_m)], axis=1)
    return poses(left, _viewpoint(random), num), poses(right, _viewpoint(random), num)


def on_a_grid(num: int, random: np.random.Generator, count: int = 8, depth_m: float = 1.15) -> list[Path6]:
    """Objects in two rows that each wander by a few centimetres."""
    columns = (count + 1) // 2
    places = [((column - (columns - 1) / 2) * 0.28, (row - 0.5) * 0.36) for row in (0, 1) for column in range(columns)]
    seconds, found = np.arange(num)[:, None] / FRAMES_PER_SECOND, []
    for x, y in places[:count]:
        offset = 0.03 * np.sin(seconds * random.uniform(1, 2, 3) + random.uniform(0, 6, 3))
        found.append(poses(offset + np.array([x, y, depth_m]), _viewpoint(random), num))
    return found


def poses(position_m: np.ndarray, rotation: Rotation, num: int) -> Path6:
    """Matrices of positions [frames, 3] and of one rotation or one a frame."""
    found = np.repeat(np.eye(4)[None], num, axis=0)
    found[:, :3, :3] = rotation.as_matrix()
    found[:, :3, 3] = position_m
    return found


def _viewpoint(random: np.random.Generator) -> Rotation:
    """An object on a table seen from above and any side."""
    return _TILT * Rotation.from_euler("z", random.uniform(0, 360), degrees=True)
