"""From the camera's axes (OpenCV: y down, z forward) to those of 3D applications: y up, cameras that look along −z."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from curio_train.color import linear_from_srgb
from curio_train.drawing.pictures import SceneContext

GL_FROM_CV = np.diag([1.0, -1.0, -1.0])
"""Turns OpenCV's camera axes to OpenGL's, which glTF and USD have, too."""

_Y, _Z = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])


def root_from_camera(context: SceneContext) -> np.ndarray:
    """Rotation [4, 4] of the camera's axes that puts the scene's up direction along +y."""
    up = GL_FROM_CV @ np.asarray(context.up, dtype=np.float64)
    return embed(_rotation_onto(up, _Y) @ GL_FROM_CV)


def towards_light(light: np.ndarray) -> tuple[np.ndarray, float]:
    """The matrix [4, 4] of a lamp that shines along −z from the light's direction, and the light's strength."""
    strength = float(np.linalg.norm(light))
    return embed(_rotation_onto(_Z, light / strength if strength else _Y)), strength


def embed(rotation: np.ndarray) -> np.ndarray:
    """A rotation [3, 3] as a matrix [4, 4]."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    return matrix


def linear(srgb: object) -> np.ndarray:
    """Colours in linear light, which 3D applications compute in."""
    values: np.ndarray = linear_from_srgb(torch.as_tensor(np.array(srgb, dtype=np.float64))).numpy()
    return values


def _rotation_onto(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """A rotation [3, 3] that turns one direction into another."""
    rotation, _ = Rotation.align_vectors(target[None], source[None])
    matrix: np.ndarray = rotation.as_matrix()
    return matrix
