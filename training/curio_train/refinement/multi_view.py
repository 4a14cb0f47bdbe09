"""Poses that photographs of one scene agree on: where it stands still while the camera moves.

One photograph is read wrongly as often as rightly, but in its own way: a can whose spout points at the camera is taken
for one that is turned away, and half of all errors lie in depth. Photographs from other sides know better. Where
structure from motion tells how the camera moved, every reading becomes a pose in the scene, and readings of several
photographs that agree there are right together (after Labbé et al. 2020, "CosyPose", section 3.2). What they agree on
is then looked for in all photographs. Objects may be moved between photographs; each place is a pose of its own.

Nothing here knows a label: the scale of the scene, which structure from motion leaves open, comes from the readings.
One object's readings err in depth all to one side, by some per cent, and with them its scale; several objects of one
scene err each in its own way (decision 68). So the cameras may be given in metres.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from curio_train.data.photographs import CameraPoses
from curio_train.geometry import Pose, matrix_from_rotation_6d, rotation_6d_from_matrix
from curio_train.refinement.render_and_compare import LEAST_SEEN, RenderAndCompare
from curio_train.scene_code import ROTATION_6D, TRANSLATION, SceneCode

_FEWEST = 3  # photographs that a pose is agreed on by
_FEWEST_READINGS = 4  # of a pose; a photograph has up to two, as read and refined
_GROWTHS = 3  # times that a pose becomes the mean of the readings near it
_LARGEST_TURN_DEG = 20.0
_ACROSS, _IN_DEPTH, _MOVED = 0.04, 0.04, 0.03  # standard deviations: diameters, shares of the distance, diameters
_LARGEST_DISTANCE = 11.3  # squared, in standard deviations: 99 of 100 readings of one position
_FEWEST_PAIRS = 30  # that a scale is told from
_LARGEST_GAP, _LEAST_BASELINE = 0.6, 0.5  # diameters: of pairs that tell of the scale
_SAME_SCALE = 0.05  # logarithms so near vote for each other
_CREDIBLE, _WEAKER = 0.3, 0.1  # of what a photograph's own reading explains of its silhouette
_CONTRADICTION = 0.25  # diameters across the view


class _Predictions(NamedTuple):
    """What was read, one a row.

    Attributes:
        frame: Number of the photograph.
        rotation: cam_from_obj, [n, 3, 3].
        translation_m: cam_from_obj, [n, 3].
    """

    frame: np.ndarray
    rotation: np.ndarray
    translation_m: np.ndarray


class _Scene(NamedTuple):
    """Cameras in a still scene.

    Attributes:
        cam_from_world: Rigid, [num, 4, 4].
        known: Of which photographs the camera is known, [num].
        scale: Metres a unit of the scene.
    """

    cam_from_world: np.ndarray
    known: np.ndarray
    scale: float

    def poses_of(self, readings: _Predictions) -> tuple[np.ndarray, np.ndarray]:
        """Rotations and positions, metres, in the scene's frame."""
        turn, shift = self.cam_from_world[readings.frame, :3, :3], self.cam_from_world[readings.frame, :3, 3]
        rotation = np.einsum("nji,njk->nik", turn, readings.rotation)
        return rotation, np.einsum("nji,nj->ni", turn, readings.translation_m - self.scale * shift)

    def seen_from(self, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
        """Rotations and positions, metres, in each camera's frame."""
        turn, shift = self.cam_from_world[:, :3, :3], self.cam_from_world[:, :3, 3]
        return turn @ pose.rotation, turn @ pose.translation_m + self.scale * shift


def agreed(
    refine: RenderAndCompare,
    frames: Tensor,
    cameras: CameraPoses,
    read: SceneCode,
    refined: tuple[SceneCode, Bool[Tensor, " num"]],
    symmetries: Sequence[Pose],
) -> tuple[dict[str, Tensor], Bool[Tensor, " num"]]:
    """Poses that photographs agree on.

    Args:
        refine: Of the object; tells what of a photograph a pose explains.
        frames: uint8 sRGB [num, 3, height, width].
        cameras: That took them.
        read: What was read in each.
        refined: The same after render-and-compare, and where that found something better.
        symmetries: Of the object.

    Returns:
        The code with agreed positions and rotations, and which photographs show the object there.
    """
    better, taken = refined
    known = cameras.known
    sources = _predictions(read, known), _predictions(better, known & taken.numpy())
    turns = np.stack([pose.rotation for pose in symmetries])
    scales = [estimate_scale(cameras, code, taken, refine.diameter_m) for code in (read, better)]
    found = [scale for scale in scales if scale is not None]
    if not found:
        return dict(read), torch.zeros(len(frames), dtype=torch.bool)
    scale = 1.0 if cameras.in_metres else float(np.exp(np.mean(np.log(found))))
    # Each kind of reading errs in depth in its own way, which its scale tells.
    pairs = zip(sources, scales, strict=True)
    level = [r._replace(translation_m=r.translation_m * scale / s) for r, s in pairs if s is not None]
    every = _Predictions(*(np.concatenate(values) for values in zip(*level, strict=True)))
    scene = _Scene(_without_gaps(cameras), known, scale)
    poses = _clusters(scene, every, refine.diameter_m, turns)
    return _looked_for(refine, frames, scene, poses, read, better, turns)


def estimate_scale(
    cameras: CameraPoses, code: SceneCode, taken: Bool[Tensor, " num"], diameter_m: float
) -> float | None:
    """Metres a unit of the scene, by how far an object that was read moved before the camera.

    Args:
        cameras: Of the photographs.
        code: What was read in them.
        taken: Readings that are better than others; these tell, if they are enough.
        diameter_m: Of the object.
    """
    matrices, known = _without_gaps(cameras), cameras.known
    scale = _scale(matrices, _predictions(code, known & taken.numpy()), diameter_m)
    return scale or _scale(matrices, _predictions(code, known), diameter_m)


def _without_gaps(cameras: CameraPoses) -> np.ndarray:
    return np.where(cameras.known[:, None, None], cameras.cam_from_world, np.eye(4))


def _predictions(code: SceneCode, chosen: np.ndarray) -> _Predictions:
    rotation = matrix_from_rotation_6d(code[ROTATION_6D][:, 0]).double().numpy()
    translation_m = code[TRANSLATION][:, 0].double().numpy()
    return _Predictions(np.flatnonzero(chosen), rotation[chosen], translation_m[chosen])


def _scale(cameras: np.ndarray, readings: _Predictions, diameter_m: float) -> float | None:
    """Metres a unit of the scene: what most pairs of photographs say, from how far the camera moved between them."""
    turn, shift = cameras[readings.frame, :3, :3], cameras[readings.frame, :3, 3]
    away = np.einsum("nji,nj->ni", turn, readings.translation_m)  # from the camera, in the scene's axes
    centres = -np.einsum("nji,nj->ni", turn, shift)
    first, second = np.triu_indices(len(away), 1)
    moved, differ = centres[first] - centres[second], away[first] - away[second]
    length = np.linalg.norm(moved, axis=1).clip(min=1e-9)
    scale = -(moved * differ).sum(axis=1) / length**2
    gap = np.linalg.norm(moved * scale[:, None] + differ, axis=1)
    fits = (scale > 0) & (gap < _LARGEST_GAP * diameter_m) & (length * scale > _LEAST_BASELINE * diameter_m)
    logs = np.sort(np.log(scale[fits]))
    if len(logs) < _FEWEST_PAIRS:
        return None
    alike = np.searchsorted(logs, logs + _SAME_SCALE) - np.searchsorted(logs, logs - _SAME_SCALE)
    mode = logs[alike.argmax()]
    near = np.abs(logs - mode) < _SAME_SCALE
    return float(np.exp(np.median(logs[near]))) if near.sum() >= _FEWEST_PAIRS else None


def _clusters(scene: _Scene, readings: _Predictions, diameter_m: float, turns: np.ndarray) -> list[Pose]:
    """Poses in the scene that readings of several photographs agree on, those of most readings first."""
    rotations, positions = scene.poses_of(readings)
    spread = _spread(scene, readings, diameter_m)
    gaps = positions[None] - positions[:, None]
    alike = _distance(gaps, spread[:, None] + spread[None]) < _LARGEST_DISTANCE
    alike &= _angles_deg(rotations[:, None], rotations, turns)[0] < _LARGEST_TURN_DEG
    left, found = np.ones(len(positions), dtype=bool), []
    while True:
        seed = int((alike & left & left[:, None]).sum(axis=1).argmax())
        members = np.flatnonzero(alike[seed] & left)
        if len(members) < _FEWEST_READINGS:
            break
        for _ in range(_GROWTHS):
            pose = _mean(rotations[members], positions[members], spread[members], turns)
            near = _distance(positions - pose.translation_m, spread) < _LARGEST_DISTANCE
            near &= _angles_deg(rotations, pose.rotation, turns)[0] < _LARGEST_TURN_DEG
            if (near & left).sum() < _FEWEST_READINGS:
                break
            members = np.flatnonzero(near & left)
        left[members] = False
        if len(np.unique(readings.frame[members])) >= _FEWEST:
            found.append(_mean(rotations[members], positions[members], spread[members], turns))
    return found


def _spread(scene: _Scene, readings: _Predictions, diameter_m: float) -> Float[np.ndarray, "n 3 3"]:
    """Covariance of each reading's position: what is across the view is known better than depth."""
    ray = np.einsum("nji,nj->ni", scene.cam_from_world[readings.frame, :3, :3], readings.translation_m)
    away = np.linalg.norm(ray, axis=1)
    along = ray[:, :, None] * ray[:, None] / away[:, None, None] ** 2
    across = np.eye(3) - along
    far = (_IN_DEPTH * away)[:, None, None] ** 2
    covariance: np.ndarray = across * (_ACROSS * diameter_m) ** 2 + along * far + np.eye(3) * (_MOVED * diameter_m) ** 2
    return covariance


def _distance(gaps: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Squared Mahalanobis distance."""
    result: np.ndarray = (gaps * np.linalg.solve(covariance, gaps[..., None])[..., 0]).sum(axis=-1)
    return result


def _angles_deg(one: np.ndarray, other: np.ndarray, turns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least angle over the symmetries between rotations [..., 3, 3], and the number of that symmetry."""
    cosines = np.stack([(np.einsum("...ij,...ij->...", one @ turn, other) - 1) / 2 for turn in turns])
    return np.degrees(np.arccos(cosines.max(axis=0).clip(-1, 1))), cosines.argmax(axis=0)


def _mean(rotations: np.ndarray, positions: np.ndarray, spread: np.ndarray, turns: np.ndarray) -> Pose:
    _, symmetry = _angles_deg(rotations, rotations[0], turns)
    rotation = Rotation.from_matrix(rotations @ turns[symmetry]).mean().as_matrix()
    weight = np.linalg.inv(spread)
    return Pose(rotation, np.linalg.solve(weight.sum(axis=0), np.einsum("nij,nj->i", weight, positions)))


def _looked_for(
    refine: RenderAndCompare,
    frames: Tensor,
    scene: _Scene,
    poses: list[Pose],
    read: SceneCode,
    better: SceneCode,
    turns: np.ndarray,
) -> tuple[dict[str, Tensor], Tensor]:
    """The pose that explains most of each photograph, if what was read there does not speak against it.

    Where the photograph's own reading explains something, the pose is to lie there, too, and to explain nearly as much;
    where it is turned otherwise, more.
    """
    own = refine.explained(frames, better).numpy()
    best, code = np.zeros(len(frames)), {name: value.clone() for name, value in read.items()}
    _, read_rotation, read_m = _predictions(better, np.ones(len(frames), dtype=bool))
    for pose in poses:
        rotation, translation_m = scene.seen_from(pose)
        turned = _angles_deg(rotation, read_rotation, turns)[0] > 2 * _LARGEST_TURN_DEG
        apart = np.linalg.norm(translation_m[:, :2] - read_m[:, :2] * (translation_m[:, 2:] / read_m[:, 2:]), axis=1)
        elsewhere = (own > _CREDIBLE) & (apart > _CONTRADICTION * refine.diameter_m)
        least = np.maximum(LEAST_SEEN, np.where(turned, own, own - _WEAKER))
        chosen = torch.from_numpy(np.flatnonzero(scene.known & refine.in_view(translation_m) & ~elsewhere))
        if len(chosen) == 0:
            continue
        placed, explained = _placed(read, rotation, translation_m), np.zeros(len(frames))
        parts = {name: value[chosen] for name, value in placed.items()}
        explained[chosen.numpy()] = refine.explained(frames[chosen], parts).numpy()
        wins = torch.from_numpy(explained > np.maximum(best, least))
        best = np.where(wins.numpy(), explained, best)
        code = {name: torch.where(_like(wins, value), placed[name], value) for name, value in code.items()}
    return code, torch.from_numpy(best > 0)


def _placed(code: SceneCode, rotation: np.ndarray, translation_m: np.ndarray) -> dict[str, Tensor]:
    pose = {
        TRANSLATION: torch.from_numpy(translation_m).float()[:, None],
        ROTATION_6D: rotation_6d_from_matrix(torch.from_numpy(rotation).float())[:, None],
    }
    return dict(code) | pose


def _like(chosen: Tensor, value: Tensor) -> Tensor:
    return chosen.view(-1, *[1] * (value.dim() - 1))
