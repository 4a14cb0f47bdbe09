"""The stage that is trained: frames of half the resolution to a heat map and positions for each object."""

from collections.abc import Sequence

from jaxtyping import Bool, Float
from torch import Tensor

from curio_train.config import NetworkConfig
from curio_train.networks.grid import gather_cells, heat_map_loss
from curio_train.networks.several_objects.locator import HEAT_MAPS, PROPOSALS, LocatorNetwork
from curio_train.networks.templates.geometry import FRAME_STRIDE
from curio_train.scene_code import CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION, Layout, SceneCode
from curio_train.worlds.base import Camera
from curio_train.worlds.generated.fields import CONFIDENCE_FIELD
from curio_train.worlds.several_objects.scenes import ObjectScenes
from curio_train.worlds.single_object.localisation_stage import POSITION_WEIGHT, camera_grid, placing_error
from curio_train.worlds.single_object.world import Object, position_field, resized

_COVERED = 0.35  # of a nearer object's diameter around its centre: what lies behind is taken as hidden
_FROM_THE_FRONT = (1.0, 0.0, 0.0, 0.0, 0.0, -1.0)  # rotation that pictures of what was found are drawn with
_LAMP = (0.0, -0.7, -0.7)


class LocatorStage(ObjectScenes):
    """Frames to positions and confidences."""

    def __init__(self, members: Sequence[Object], frame: Camera) -> None:
        """Build for frames of this camera."""
        camera = resized(members[0].camera, frame.width // FRAME_STRIDE, frame.height // FRAME_STRIDE)
        layout = Layout((position_field(members[0]), CONFIDENCE_FIELD), num_slots=len(members))
        super().__init__("localisation", members, camera, layout)

    def network(self, config: NetworkConfig) -> LocatorNetwork:
        """A new network with a heat map an object; its trunk is empty."""
        return LocatorNetwork(camera_grid(self.camera, self.layout[TRANSLATION]), len(self.members))

    def render(self, code: SceneCode, backgrounds: Tensor | None = None) -> Tensor:
        """What was found, as it would look from the front: this stage reads no rotation and no light."""
        position = code[TRANSLATION]
        front = position.new_tensor(_FROM_THE_FRONT).expand(*position.shape[:2], 6)
        lamp = position.new_tensor(_LAMP).expand(len(position), 3)
        return super().render({ROTATION_6D: front, LIGHT: lamp, **code}, backgrounds)

    def code_loss(self, predicted: SceneCode, true: SceneCode) -> Float[Tensor, ""]:
        """Cross entropy of the heat maps, and the errors of the proposals at the centres (after Zhou et al. 2019).

        An image teaches nothing about an object that another one hides, or whose true confidence is NaN: nobody knows
        whether it is there.
        """
        position, present = true[TRANSLATION], true[CONFIDENCE][..., 0] > 0.5
        taught = ~self._hidden(position, present) & ~true[CONFIDENCE][..., 0].isnan()
        grid = camera_grid(self.camera, self.layout[TRANSLATION]).to(position.device)
        splat = grid.splat_weights(grid.project(position))  # [batch, objects, 4]
        rows = position.shape[0] * position.shape[1]
        one_each = type(splat)(*(values.reshape(rows, 1, 4) for values in splat))
        shown = type(splat)(one_each.cell, one_each.weight * present.reshape(rows, 1, 1))
        heat = heat_map_loss(predicted[HEAT_MAPS].flatten(0, 1), shown).unflatten(0, position.shape[:2])
        found = gather_cells(predicted[PROPOSALS].flatten(0, 1), one_each).unflatten(0, position.shape[:2])[:, :, 0]
        error = placing_error(found, position[:, :, None], self.camera)
        placed = (error * splat.weight).sum(dim=-1) * present
        return ((heat + POSITION_WEIGHT * placed) * taught).sum(dim=1).mean()

    def _hidden(
        self, position_m: Float[Tensor, "batch objects 3"], present: Bool[Tensor, "batch objects"]
    ) -> Bool[Tensor, "batch objects"]:
        """Objects whose centres lie behind a nearer one."""
        slope, depth = position_m[..., :2] / position_m[..., 2:], position_m[..., 2]
        diameter_m = position_m.new_tensor([kind.diameter_m for kind in self.objects])
        apart = (slope[:, :, None] - slope[:, None]).norm(dim=-1)
        behind = (depth[:, :, None] > depth[:, None]) & present[:, None] & present[:, :, None]
        return (behind & (apart < _COVERED * diameter_m / depth[:, None])).any(dim=2)
