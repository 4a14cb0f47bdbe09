"""How objects can stand on a plane, for :mod:`curio_serve.planes.standing`."""

import json
import math
from collections.abc import Sequence

import numpy as np
import trimesh
from curio_proto.v1.model_spec_pb2 import StablePoses
from google.protobuf import json_format
from jaxtyping import Float

_DIRECTIONS = 256  # the hull's points are those farthest in these; a ball loses a hundredth of its radius between them
_PARTS = 32  # of these, one after the other: a mesh may have millions of vertices
_LEAST_PROBABILITY = 0.01  # of coming to rest on a side
_NEAR = math.cos(math.radians(8))  # of two sides that count as one: less than what networks read rotations by
_FLAT = 1e-4  # of the longest extent: no body that stands on its rim
_DECIMALS_M = 6


def hull_points(vertices_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k 3"]:
    """The points of a mesh that are farthest in any of many directions: its convex hull, nearly."""
    number = np.arange(_DIRECTIONS) + 0.5
    height, turn = 1 - 2 * number / _DIRECTIONS, math.pi * (1 + math.sqrt(5)) * number  # a Fibonacci sphere
    around = np.sqrt(1 - height**2)
    directions = np.stack([around * np.cos(turn), around * np.sin(turn), height], axis=1)
    farthest = [(vertices_m @ part.T).argmax(axis=0) for part in np.array_split(directions, _PARTS)]
    points: np.ndarray = vertices_m[np.unique(np.concatenate(farthest))]
    return points


def stable_up(hull_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k 3"]:
    """For each pose in which a solid body of even density stands, the direction away from the plane, object frame.

    A side on which it comes to rest less often than once in a hundred throws is left out.

    Args:
        hull_m: Points of its convex hull; a flat one lies on either side, a rod without width on none.
    """
    spread, axes = np.linalg.svd(hull_m - hull_m.mean(axis=0), full_matrices=False)[1:]
    if len(spread) < 3 or spread[1] <= _FLAT * spread[0]:
        return np.zeros((0, 3))
    if spread[2] <= _FLAT * spread[0]:
        return np.stack([axes[2], -axes[2]])
    solid = trimesh.convex.convex_hull(hull_m)
    plane_from_object, probabilities = trimesh.poses.compute_stable_poses(solid, n_samples=1, sigma=0, threshold=0.0)
    return _apart(np.reshape(plane_from_object, (-1, 4, 4))[:, 2, :3], np.asarray(probabilities))


def _apart(up: Float[np.ndarray, "n 3"], probabilities: Float[np.ndarray, " n"]) -> Float[np.ndarray, "k 3"]:
    """The likeliest directions, those near one of them left out: the round side of a cylinder is very many sides."""
    found: list[np.ndarray] = []
    left = probabilities.copy()
    while left.max(initial=0) > 0:
        best = int(left.argmax())
        near = (up @ up[best] > _NEAR) & (left > 0)
        if left[near].sum() >= _LEAST_PROBABILITY:
            found.append(up[best])
        left[near] = 0
    return np.reshape(found, (-1, 3))


def stable_poses(hulls_m: Sequence[tuple[str, Float[np.ndarray, "n 3"]]]) -> StablePoses:
    """What a model says of how its objects can stand.

    Args:
        hulls_m: Name and :func:`hull_points` of each object.
    """
    found = StablePoses()
    for name, hull_m in hulls_m:
        rounded, up = np.round(hull_m, _DECIMALS_M), np.round(stable_up(hull_m), _DECIMALS_M)
        found.objects.add(object=name, hull_m=rounded.ravel(), up=up.ravel())
    return found


def to_text(found: StablePoses) -> str:
    """The content of ``stable_poses.json``, an object a line."""
    objects = [json.dumps(json_format.MessageToDict(one, preserving_proto_field_name=True)) for one in found.objects]
    return '{"objects": [\n' + ",\n".join(objects) + "\n]}\n"
