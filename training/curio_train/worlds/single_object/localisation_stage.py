"""The localisation stage: images, codes and loss. Its frames have a quarter of the resolution, its code a position."""

from jaxtyping import Float
from torch import Tensor

from curio_train.config import NetworkConfig
from curio_train.data.augmentation import WHOLE_FRAME, AugmentationStrength
from curio_train.geometry import Pose
from curio_train.networks.grid import CellGrid, gather_cells, heat_map_loss
from curio_train.networks.two_stage.localise import HEAT_MAP, PROPOSALS, LocalisationNetwork
from curio_train.scene_code import LIGHT, TRANSLATION, Field, Layout, SceneCode
from curio_train.worlds.base import Camera
from curio_train.worlds.single_object.viewpoints import MILD_EXPOSURE, Exposure
from curio_train.worlds.single_object.world import Object, SingleObjectWorld, position_field, resized

LOCALISATION_STRIDE = 4
"""Frame pixels per pixel of this stage, each way."""

POSITION_WEIGHT = 0.3
"""Weight of the proposals' errors beside the heat map's."""

_SLOPE_SCALE_PX = 2.0  # of a stage's pixels: an error that costs 1
_LOG_DEPTH_SCALE = 0.1


class LocalisationStage(SingleObjectWorld):
    """Whole frames at low resolution; the network predicts positions."""

    num_instances, random_appearance = 3, True

    def __init__(self, object_: Object, frame: Camera) -> None:
        """Build for frames of this camera."""
        camera = resized(object_.camera, frame.width // LOCALISATION_STRIDE, frame.height // LOCALISATION_STRIDE)
        super().__init__("localisation", object_, camera, Layout((position_field(object_),)))

    @property
    def augmentation(self) -> AugmentationStrength:
        """Colours change little: at a dozen pixels they tell the object from other things."""
        return super().augmentation if self.object.known_scene else WHOLE_FRAME

    @property
    def exposure(self) -> Exposure:
        """Mild, because colours tell the object from other things."""
        return MILD_EXPOSURE

    def sample(self, count: int, seed: tuple[int, ...]) -> dict[str, Tensor]:
        """Several copies of the object in a frame, under one light: each is a label, and the frame is rendered once."""
        code = super().sample(count * self.num_instances, seed)
        light = code.pop(LIGHT)[:count]
        return {name: value.reshape(count, self.num_instances, -1) for name, value in code.items()} | {LIGHT: light}

    def network(self, config: NetworkConfig) -> LocalisationNetwork:
        """A new network that proposes a position at each grid cell."""
        return LocalisationNetwork(camera_grid(self.camera, self.layout[TRANSLATION]))

    def code_loss(self, predicted: SceneCode, true: SceneCode) -> Float[Tensor, ""]:
        """Cross entropy of the centre heat map, and the errors of the proposals at centres (after Zhou et al. 2019).

        Each object is splatted onto the four cells around its centre; all other cells only learn that they have none.
        So two red things in an image are two proposals instead of a mean between them.
        """
        position = true[TRANSLATION]
        grid = camera_grid(self.camera, self.layout[TRANSLATION]).to(position.device)
        splat = grid.splat_weights(grid.project(position))
        found, wanted = gather_cells(predicted[PROPOSALS], splat), position[:, :, None]  # [batch, objects, 4, 3]
        position_loss = (placing_error(found, wanted, self.camera) * splat.weight).sum(dim=-1).mean()
        heat_loss = heat_map_loss(predicted[HEAT_MAP], splat).mean() / position.shape[1]
        return heat_loss + POSITION_WEIGHT * position_loss


def placing_error(
    found_m: Float[Tensor, "*batch 3"], wanted_m: Float[Tensor, "*#batch 3"], camera: Camera
) -> Float[Tensor, "*batch"]:
    """How far positions in the camera's frame are off, across and along the line of sight.

    Args:
        found_m: Proposals, in front of the camera.
        wanted_m: The true ones.
        camera: Of the stage's images; it has K.
    """
    assert camera.matrix is not None
    slope = found_m[..., :2] / found_m[..., 2:] - wanted_m[..., :2] / wanted_m[..., 2:]
    log_depth = found_m[..., 2].log() - wanted_m[..., 2].log()
    slope_scale = _SLOPE_SCALE_PX / float(camera.matrix[0, 0])
    return slope.norm(dim=-1) / slope_scale + log_depth.abs() / _LOG_DEPTH_SCALE


def camera_grid(camera: Camera, position: Field) -> CellGrid:
    """The cells of a camera's images, for positions in the camera's frame."""
    assert camera.matrix is not None
    return CellGrid(position, camera.matrix, Pose.identity(), (camera.width, camera.height), on_plane=False)
