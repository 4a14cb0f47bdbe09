"""The loss of the crop-pose stage."""

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from curio_train.geometry import matrix_from_rotation_6d, rotation_6d_from_matrix
from curio_train.metrics.poses import ADD_THRESHOLD, symmetry_poses
from curio_train.networks.grid import STRIDE, per_cell
from curio_train.networks.two_stage.crop_pose import OBJECT_COORDINATES, OBJECT_COORDINATES_STRIDE
from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION, SceneCode
from curio_train.worlds.single_object.world import Object

ASSUMED_DEPTH = "assumed_depth_m"
"""Key of the depth estimated by the localisation stage [batch, 1]: given beside the code, never predicted."""

SYMMETRY_STEP = 0.1
"""Continuous symmetries count as one rotation in so many parts of a full one: 31."""

_NUM_POINTS = 128
_ROTATION_6D_WEIGHT = 0.5
_COORDINATES_WEIGHT = 3.0  # the rotation is predicted from features that learn from them
_LIGHT_WEIGHT = 0.05
_COLOR_WEIGHT = 0.1  # light and exposure leave it uncertain
_CONFIDENCE_WEIGHT = 0.2


class CropPoseLoss:
    """Displacement of the mesh's points by rotation, offset and depth, in diameters, beside terms for all else.

    Of symmetric poses the one nearest to the prediction is the true one. In crops without the object only confidence
    and object coordinates count. The six numbers of the rotation are compared as they are, too: while nothing is known
    no rotation displaces points less than another, but numbers near zero have a smaller error than others. The
    confidence learns whether ADD is below a tenth of the diameter.
    """

    def __init__(self, object_: Object) -> None:
        """Choose the points of the object's mesh."""
        self._diameter_m, vertices = object_.kind.diameter_m, object_.mesh.vertices_m
        chosen = np.random.default_rng(0).choice(len(vertices), min(_NUM_POINTS, len(vertices)), replace=False)
        self._points = torch.from_numpy(vertices[chosen] / self._diameter_m).float()
        # Turns about the mesh's origin; by how much those of scanned objects miss it are a few millimetres.
        self._turns_any_way = object_.kind.info.turns_any_way
        symmetries = [pose.rotation for pose in symmetry_poses(object_.kind.info, SYMMETRY_STEP)]
        self._symmetries = torch.from_numpy(np.stack(symmetries)).float()

    def __call__(self, predicted: SceneCode, true: SceneCode) -> Float[Tensor, ""]:
        """The mean over the crops of a batch."""
        present = true[CONFIDENCE][:, 0, 0]
        if self._turns_any_way:
            true = _turned_alike(predicted, true)
        equivalent, displacement = self._displacement(predicted[ROTATION_6D][:, 0], true[ROTATION_6D][:, 0])
        of_rotation, nearest = displacement.norm(dim=-1).mean(dim=-1).min(dim=1)
        wanted_6d = rotation_6d_from_matrix(equivalent[torch.arange(len(nearest)), nearest])
        numbers = (predicted[ROTATION_6D][:, 0] - wanted_6d).square().sum(dim=-1)
        offset, depth = self._position_error(predicted[TRANSLATION], true[TRANSLATION], true[ASSUMED_DEPTH])
        light = (predicted[LIGHT] - true[LIGHT]).norm(dim=-1)
        pose = of_rotation + _ROTATION_6D_WEIGHT * numbers + (offset + depth)[:, 0] + _LIGHT_WEIGHT * light
        if COLOR in predicted:
            pose = pose + _COLOR_WEIGHT * (predicted[COLOR] - true[COLOR])[:, 0].abs().mean(dim=-1)
        pose = pose + self._cell_loss(predicted, wanted_6d, true)
        pose_loss = (pose * present).sum() / present.sum().clamp(min=1)
        confidence_loss = self._confidence_loss(predicted, true, displacement)
        coordinates_loss = self._coordinates_loss(predicted[OBJECT_COORDINATES], true)
        return pose_loss + _CONFIDENCE_WEIGHT * confidence_loss + _COORDINATES_WEIGHT * coordinates_loss

    def _displacement(
        self, found_6d: Float[Tensor, "batch 6"], wanted_6d: Float[Tensor, "batch 6"]
    ) -> tuple[Float[Tensor, "batch symmetries 3 3"], Float[Tensor, "batch symmetries points 3"]]:
        """The symmetric true rotations, and the displacement of each point from each of them, in diameters."""
        found, wanted = matrix_from_rotation_6d(found_6d), matrix_from_rotation_6d(wanted_6d)
        equivalent = wanted[:, None] @ self._symmetries.to(wanted)
        points = self._points.to(wanted)[..., None]
        return equivalent, ((found[:, None, None] @ points) - (equivalent[:, :, None] @ points)).squeeze(-1)

    def _confidence_loss(self, predicted: SceneCode, true: SceneCode, displacement: Tensor) -> Float[Tensor, ""]:
        """Cross entropy between the confidence and whether the pose is correct: ADD below a tenth of the diameter."""
        present = true[CONFIDENCE][:, 0, 0]
        positions_m = (
            position_in_metres(code[TRANSLATION][:, 0], true[ASSUMED_DEPTH], self._diameter_m)
            for code in (predicted, true)
        )
        shift = torch.sub(*positions_m)
        add = (displacement + shift[:, None, None] / self._diameter_m).norm(dim=-1).mean(dim=-1).amin(dim=1)
        correct = (add < ADD_THRESHOLD).to(present) * present
        return F.binary_cross_entropy(predicted[CONFIDENCE][:, 0, 0].clamp(1e-6, 1 - 1e-6), correct)

    def _cell_loss(self, predicted: SceneCode, rotation_6d: Tensor, true: SceneCode) -> Float[Tensor, " batch"]:
        """Per-cell pose loss, averaged over the cells that see the object; same terms as for the final pose.

        All cells learn the symmetric pose that is nearest to the final one, so that they agree.
        """
        visible = F.avg_pool2d(true[OBJECT_COORDINATES][:, 3:], STRIDE // OBJECT_COORDINATES_STRIDE).flatten(1)
        weight = visible / visible.sum(dim=1, keepdim=True).clamp(min=1)
        numbers = (predicted[per_cell(ROTATION_6D)] - rotation_6d[:, None]).square().sum(dim=-1)
        offset, depth = self._position_error(predicted[per_cell(TRANSLATION)], true[TRANSLATION], true[ASSUMED_DEPTH])
        return (weight * (_ROTATION_6D_WEIGHT * numbers + offset + depth)).sum(dim=1)

    def _position_error(self, position: Tensor, true: Tensor, assumed_depth_m: Tensor) -> tuple[Tensor, Tensor]:
        """Errors across the view and in depth, in diameters, [batch, any number]."""
        offset = (position[..., :2] / position[..., 2:] - true[..., :2] / true[..., 2:]).norm(dim=-1)
        distance = assumed_depth_m / self._diameter_m
        return offset, distance * (position[..., 2].log() - true[..., 2].log()).abs()

    def _coordinates_loss(self, predicted: Float[Tensor, "batch 4 side side"], true: SceneCode) -> Float[Tensor, ""]:
        """Mean absolute error of object coordinates where the object is visible, and cross entropy of visibility."""
        points, visible = true[OBJECT_COORDINATES].split((3, 1), dim=1)
        mask = (visible * true[CONFIDENCE][..., None])[:, None]  # [batch, 1, 1, side, side]
        equivalent = torch.einsum("sij,bjvu->bsivu", self._symmetries.to(points).transpose(1, 2), points)
        errors = ((predicted[:, None, :3] - equivalent).abs() * mask).sum((2, 3, 4)) / mask.sum((2, 3, 4)).clamp(min=1)
        return errors.amin(dim=1).mean() + F.binary_cross_entropy_with_logits(predicted[:, 3], mask[:, 0, 0])


def _turned_alike(predicted: SceneCode, true: SceneCode) -> SceneCode:
    """The true code of a ball, whose every rotation is right: that which is predicted, with its object coordinates."""
    visible = true[OBJECT_COORDINATES][:, 3:]
    coordinates = torch.cat([predicted[OBJECT_COORDINATES][:, :3].detach(), visible], dim=1)
    return {**true, ROTATION_6D: predicted[ROTATION_6D].detach(), OBJECT_COORDINATES: coordinates}


def position_in_metres(
    position: Float[Tensor, "batch 3"], assumed_depth_m: Float[Tensor, "batch 1"], diameter_m: float
) -> Float[Tensor, "batch 3"]:
    """Metres in the crop camera's frame of a position in (diameters, diameters, assumed depths)."""
    return torch.cat([position[:, :2] * diameter_m, position[:, 2:] * assumed_depth_m], dim=-1)
