"""A gaze at one object: a first look at the whole frame says where it is, a second at a crop says the rest.

On whole frames a full rotation is slow to learn even with labels; on crops it takes minutes. So each look is a world of
its own, with its own images and code, and both are learned by the same loop in turns. What the second look sees is
rendered as a camera that is turned to the object would see it: no frame is ever cropped while learning.

Constants fixed before any training:

* the first look sees a quarter of the frame's resolution;
* a crop of 64 pixels in which the object's diameter spans 0.6 of the side, if it is as far as the first look says;
* the first look may be off by a quarter of the diameter to each side, and by a quarter (as e^±0.25) in distance;
* in one crop of seven there is no object.

Confidence is the probability that ADD is below a tenth of the diameter: the second look learns to foretell whether its
own answers are right. Where there is no object none is.
"""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from curio_train.camera import Intrinsics
from curio_train.config import NetworkConfig
from curio_train.data.augmentation import WHOLE_FRAME, AugmentationStrength
from curio_train.data.backgrounds import Backgrounds
from curio_train.data.photographs import UnlabelledPhotographs
from curio_train.geometry import Pose, matrix_from_rotation_6d, rotation_6d_from_matrix
from curio_train.metrics.poses import ADD_THRESHOLD, symmetry_poses
from curio_train.networks.base import StageNetwork
from curio_train.networks.grid import STRIDE, CellGrid, gather_cells, heat_map_loss, per_cell
from curio_train.networks.two_stage.crop_pose import OBJECT_COORDINATES, OBJECT_COORDINATES_STRIDE, CropPoseNetwork
from curio_train.networks.two_stage.localise import HEAT_MAP, PROPOSALS, LocalisationNetwork
from curio_train.networks.two_stage.network import Optics, TwoStageNetwork
from curio_train.rendering.object_coordinates import ObjectCoordinateMap
from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION, Field, Layout, SceneCode
from curio_train.worlds.base import Camera
from curio_train.worlds.single_object.confidence import calibrate
from curio_train.worlds.single_object.viewpoints import MILD_EXPOSURE, Exposure, turned_towards
from curio_train.worlds.single_object.world import (
    Object,
    SingleObjectWorld,
    pose_layout,
    position_field,
    resized,
    scene,
)

ASSUMED_M = "assumed_depth_m"
"""How far the first look says the object is [batch, 1]: known beside the code, never predicted."""

LONGEST_SIDE_PX = 640
LOCALISATION_STRIDE = 4
CROP_PX, FILL = 64, 0.6
LARGEST_OFFSET, LARGEST_LOG_SCALE = 0.25, 0.25
ABSENT_SHARE = 1 / 7
STAGE_SCHEDULE, STAGE_SCHEDULE_IN_KNOWN_SCENE = (0, 1, 1), (0, 1, 1, 1, 1)
"""Which look each step teaches: rotation takes longer than place, most of all before a known scene."""

_PLACE_SCALE_PX = 2.0  # of the first look's pixels: what counts as near
_DEPTH_SCALE = 0.1  # of the logarithm
_PLACE_WEIGHT = 0.3  # beside whether there is an object at all
_NUM_POINTS = 128
_NUMBERS_WEIGHT = 0.5
_SURFACE_WEIGHT = 3.0  # it teaches what the rotation is read from
_LIGHT_WEIGHT = 0.05
_COLOR_WEIGHT = 0.1  # light and exposure leave it uncertain
_CONFIDENCE_WEIGHT = 0.2
SYMMETRY_STEP = 0.1  # continuous symmetries count as one in so many parts of a turn: 31


def frame_camera(frame: Intrinsics) -> Camera:
    """The canonical camera of a gaze: the frame's own, at most 640 pixels long, in whole pixels of the first look."""
    scale = min(1.0, LONGEST_SIDE_PX / max(frame.width, frame.height))
    step = 2 * LOCALISATION_STRIDE
    return resized(frame, step * round(frame.width * scale / step), step * round(frame.height * scale / step))


class TwoStageWorld(SingleObjectWorld):
    """One object anywhere in a frame that is read at two looks."""

    def __init__(self, name: str, thing: Object) -> None:
        """Name it as it is called on the command line."""
        self.name = name
        camera = frame_camera(thing.camera)
        super().__init__(thing, camera, pose_layout(position_field(thing), confidence=True, color=thing.painted))
        self._stages = LocalisationStage(thing, camera), CropPoseStage(thing)

    @property
    def stages(self) -> tuple["LocalisationStage", "CropPoseStage"]:
        """The whole frame and the crop."""
        return self._stages

    @property
    def turns(self) -> tuple[int, ...]:
        """A step for the frame, then several for the crop."""
        return STAGE_SCHEDULE_IN_KNOWN_SCENE if self.object.known_scene else STAGE_SCHEDULE

    @property
    def exposure(self) -> Exposure:
        """That of the look which has to find the object."""
        return self.stages[0].exposure

    def unlabelled(self) -> UnlabelledPhotographs:
        """The photographs that self-training learns from; none, unless a world has some.

        Raises:
            DataError: The folder of photographs cannot be read.
            CameraError: The file of camera poses cannot be used.
        """
        return UnlabelledPhotographs(())

    def finish(self, network: nn.Module, cache: Path) -> None:
        """The confidence is calibrated."""
        calibrate(network, self, cache)

    def assemble(self, networks: Sequence[StageNetwork]) -> nn.Module:
        """Both looks in one."""
        first, second = networks
        assert self.camera.matrix is not None
        optics = Optics(
            self.camera.matrix, self.object.kind.diameter_m, self.object.near_m, LOCALISATION_STRIDE, CROP_PX, FILL
        )
        return TwoStageNetwork(first, second, optics)


class LocalisationStage(SingleObjectWorld):
    """Whole frames at low resolution, of which only the place is read."""

    name, num_shown, finished = "first look", 3, True

    def __init__(self, thing: Object, frame: Camera) -> None:
        camera = resized(thing.camera, frame.width // LOCALISATION_STRIDE, frame.height // LOCALISATION_STRIDE)
        super().__init__(thing, camera, Layout((position_field(thing),)))

    @property
    def augmentation(self) -> AugmentationStrength:
        """Little of colours: at a dozen pixels they are what tells the object from other things."""
        return super().augmentation if self.object.known_scene else WHOLE_FRAME

    @property
    def exposure(self) -> Exposure:
        """Little for the same reason."""
        return MILD_EXPOSURE

    def sample(self, count: int, seed: tuple[int, ...]) -> dict[str, Tensor]:
        """Several of the object in a frame, under one light: each teaches a place, and the frame is paid for once."""
        code = super().sample(count * self.num_shown, seed)
        light = code.pop(LIGHT)[:count]
        return {name: value.reshape(count, self.num_shown, -1) for name, value in code.items()} | {LIGHT: light}

    def network(self, config: NetworkConfig) -> LocalisationNetwork:
        """Hypotheses on a grid."""
        return LocalisationNetwork(_grid(self))

    def code_loss(self, predicted: SceneCode, true: SceneCode) -> Float[Tensor, ""]:
        """Which cells have an object beside them, and where those say that it is (after Zhou et al. 2019).

        Each place is shared out among the four cells around it; all others only learn that they have none. So two red
        things in the picture are two hypotheses, and never a mean between them.
        """
        place, grid = true[TRANSLATION], _grid(self).to(true[TRANSLATION].device)
        here = grid.splat_weights(grid.project(place))
        said, wanted = gather_cells(predicted[PROPOSALS], here), place[:, :, None]  # [batch, objects, 4, 3]
        slope = said[..., :2] / said[..., 2:] - wanted[..., :2] / wanted[..., 2:]
        depth = said[..., 2].log() - wanted[..., 2].log()
        distance = slope.norm(dim=-1) / self._slope_scale + depth.abs() / _DEPTH_SCALE
        placed = (distance * here.weight).sum(dim=-1).mean()
        return heat_map_loss(predicted[HEAT_MAP], here).mean() / place.shape[1] + _PLACE_WEIGHT * placed

    @property
    def _slope_scale(self) -> float:
        assert self.camera.matrix is not None
        return _PLACE_SCALE_PX / float(self.camera.matrix[0, 0])


class CropPoseStage(SingleObjectWorld):
    """Crops around the object, read as position relative to the crop, rotation and light in the crop's camera.

    The position is (x, y) in diameters and z in assumed depths, so that the crop's K is the same for all: focal
    length FILL · CROP_PX, centre in the middle. The real crop camera has FILL · CROP_PX · assumed depth / diameter.
    """

    name, finished = "second look", True
    given = (ASSUMED_M,)

    def __init__(self, thing: Object) -> None:
        middle = (CROP_PX - 1) / 2
        focal = FILL * CROP_PX
        camera = Camera(CROP_PX, CROP_PX, np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]]))
        reach = 1.5 * LARGEST_OFFSET, float(np.exp(1.5 * LARGEST_LOG_SCALE))
        position = Field(
            TRANSLATION,
            3,
            unit="1",
            frame="crop",
            activation="perspective",
            lower=(-reach[0], -reach[0], 1 / reach[1]),
            upper=(reach[0], reach[0], reach[1]),
        )
        super().__init__(thing, camera, pose_layout(position, confidence=True, color=thing.painted))

    def network(self, config: NetworkConfig) -> CropPoseNetwork:
        """A small residual network whose cells say the pose."""
        return CropPoseNetwork(self.layout, _grid(self))

    def sample(self, count: int, seed: tuple[int, ...]) -> dict[str, Tensor]:
        """Objects near the middle of crops, as a first look that errs leaves them."""
        random = np.random.default_rng(seed)
        offset = random.uniform(-LARGEST_OFFSET, LARGEST_OFFSET, (count, 2))
        scale = np.exp(random.uniform(-LARGEST_LOG_SCALE, LARGEST_LOG_SCALE, (count, 1)))
        assumed = torch.from_numpy(random.uniform(self.object.near_m, self.object.far_m, (count, 1))).float()
        place = torch.from_numpy(np.concatenate([offset * scale, scale], axis=1)).float()
        rotation = turned_towards(self._metres(place, assumed), self.object.views(count, random))
        code = scene(place, rotation, self.lights(count, random)) | {ASSUMED_M: assumed}
        code |= self.paint(count, random)
        code[CONFIDENCE] = torch.from_numpy(random.random((count, 1, 1)) >= ABSENT_SHARE).float()
        return self._with_surface(code, rotation, self._metres(place, assumed))

    def mistaken(self, position_m: Float[Tensor, "count 3"], random: np.random.Generator) -> Float[Tensor, "count 3"]:
        """Where a first look that errs may take objects at these positions in the frame's camera to be, metres."""
        count = len(position_m)
        offset = random.uniform(-LARGEST_OFFSET, LARGEST_OFFSET, (count, 2)) * self.object.kind.diameter_m
        scale = np.exp(random.uniform(-LARGEST_LOG_SCALE, LARGEST_LOG_SCALE, (count, 1)))
        shift = np.concatenate([offset * scale, np.zeros((count, 1))], axis=1)
        return (position_m - torch.from_numpy(shift).to(position_m)) / torch.from_numpy(scale).to(position_m)

    def labelled(
        self,
        seen: SceneCode,
        position_m: Float[Tensor, "count 3"],
        rotation: Float[Tensor, "count 3 3"],
        assumed_m: Float[Tensor, "count 1"],
    ) -> dict[str, Tensor]:
        """The codes of crops that show the object.

        Args:
            seen: The object's colour, if it has one to be read, and the light, in the crops' cameras.
            position_m: In the crops' cameras.
            rotation: crop_from_obj.
            assumed_m: How far the object was taken to be.
        """
        place = torch.cat([position_m[:, :2] / self.object.kind.diameter_m, position_m[:, 2:] / assumed_m], dim=1)
        code = scene(place, rotation, seen[LIGHT]) | {ASSUMED_M: assumed_m}
        code |= {name: seen[name] for name in (COLOR,) if name in self.layout}
        code[CONFIDENCE] = torch.ones(len(place), 1, 1)
        return self._with_surface(code, rotation, position_m)

    def _with_surface(self, code: dict[str, Tensor], rotation: Tensor, position_m: Tensor) -> dict[str, Tensor]:
        points, seen = self._surface(rotation, position_m, self._matrices(code, CROP_PX // OBJECT_COORDINATES_STRIDE))
        return code | {OBJECT_COORDINATES: torch.cat([points, seen[:, None]], dim=1)}

    def backgrounds(self, cache: Path) -> Backgrounds:
        """Such parts of them as crops show."""
        focal_per_width = self.object.camera.matrix[0, 0] / self.object.camera.width
        side_m = self.object.kind.diameter_m / FILL
        largest, least = (focal_per_width * side_m / z for z in (self.object.near_m, self.object.far_m))
        return self.object.backgrounds(cache).of_crops(least, largest)

    def render(self, code: SceneCode, backgrounds: Tensor | None = None) -> Tensor:
        """The object as the camera of each crop sees it; ``assumed_depth_m`` must stand in the code."""
        place = self._metres(code[TRANSLATION][:, 0].float(), code[ASSUMED_M].float())
        return self._image(code, place[:, None], self._matrices(code, CROP_PX), backgrounds)

    def code_loss(self, predicted: SceneCode, true: SceneCode) -> Float[Tensor, ""]:
        """How far the model's points are displaced by rotation, offset and depth, in diameters, beside the light.

        Of poses that look alike the one nearest to the prediction is the true one. Where there is no object only
        confidence and the surface count. The six numbers of the rotation count as they are, too: while nothing is
        known of it no rotation displaces less than another, but numbers near zero do err less than others.
        """
        there = true[CONFIDENCE][:, 0, 0]
        found, wanted = (matrix_from_rotation_6d(code[ROTATION_6D][:, 0]) for code in (predicted, true))
        alike = (wanted[:, None] @ self._turns.to(wanted))[:, :, None]  # [batch, symmetries, 1, 3, 3]
        points = self._points.to(wanted)[..., None]
        between = ((found[:, None, None] @ points) - (alike @ points)).squeeze(-1)
        displaced, nearest = between.norm(dim=-1).mean(dim=-1).min(dim=1)
        wanted_6d = rotation_6d_from_matrix(alike[torch.arange(len(nearest)), nearest, 0])
        numbers = (predicted[ROTATION_6D][:, 0] - wanted_6d).square().sum(dim=-1)
        offset, depth = self._place_error(predicted[TRANSLATION], true[TRANSLATION], true[ASSUMED_M])
        light = (predicted[LIGHT] - true[LIGHT]).norm(dim=-1)
        pose = displaced + _NUMBERS_WEIGHT * numbers + (offset + depth)[:, 0] + _LIGHT_WEIGHT * light
        if COLOR in self.layout:
            pose = pose + _COLOR_WEIGHT * (predicted[COLOR] - true[COLOR])[:, 0].abs().mean(dim=-1)
        shift = torch.sub(*(self._metres(code[TRANSLATION][:, 0], true[ASSUMED_M]) for code in (predicted, true)))
        add = (between + shift[:, None, None] / self.object.kind.diameter_m).norm(dim=-1).mean(dim=-1).amin(dim=1)
        right = (add < ADD_THRESHOLD).to(there) * there
        sure = F.binary_cross_entropy(predicted[CONFIDENCE][:, 0, 0].clamp(1e-6, 1 - 1e-6), right)
        pose = pose + self._cell_error(predicted, wanted_6d, true)
        pose_loss = (pose * there).sum() / there.sum().clamp(min=1)
        surface = self._surface_loss(predicted[OBJECT_COORDINATES], true)
        return pose_loss + _CONFIDENCE_WEIGHT * sure + _SURFACE_WEIGHT * surface

    def _cell_error(self, predicted: SceneCode, rotation_6d: Tensor, true: SceneCode) -> Float[Tensor, " batch"]:
        """How far what each cell that sees the object says of its pose is from the truth, as the whole answer counts.

        Of poses that look alike cells are taught the one that is nearest to the answer: they are to agree.
        """
        seen = F.avg_pool2d(true[OBJECT_COORDINATES][:, 3:], STRIDE // OBJECT_COORDINATES_STRIDE).flatten(1)
        share = seen / seen.sum(dim=1, keepdim=True).clamp(min=1)
        numbers = (predicted[per_cell(ROTATION_6D)] - rotation_6d[:, None]).square().sum(dim=-1)
        offset, depth = self._place_error(predicted[per_cell(TRANSLATION)], true[TRANSLATION], true[ASSUMED_M])
        return (share * (_NUMBERS_WEIGHT * numbers + offset + depth)).sum(dim=1)

    def _place_error(self, place: Tensor, true_place: Tensor, assumed: Tensor) -> tuple[Tensor, Tensor]:
        """Across and in depth, by how many diameters the object is displaced; [batch, any number]."""
        offset = (place[..., :2] / place[..., 2:] - true_place[..., :2] / true_place[..., 2:]).norm(dim=-1)
        away = assumed / self.object.kind.diameter_m
        return offset, away * (place[..., 2].log() - true_place[..., 2].log()).abs()

    def _surface_loss(self, surface: Float[Tensor, "batch 4 side side"], true: SceneCode) -> Float[Tensor, ""]:
        """Whether each patch sees the object, and where it does, which point of it (mean absolute coordinate error)."""
        points, seen = true[OBJECT_COORDINATES].split((3, 1), dim=1)
        mask = (seen * true[CONFIDENCE][..., None])[:, None]  # [batch, 1, 1, side, side]
        turned = torch.einsum("sij,bjvu->bsivu", self._turns.to(points).transpose(1, 2), points)
        errors = ((surface[:, None, :3] - turned).abs() * mask).sum((2, 3, 4)) / mask.sum((2, 3, 4)).clamp(min=1)
        return errors.amin(dim=1).mean() + F.binary_cross_entropy_with_logits(surface[:, 3], mask[:, 0, 0])

    def _matrices(self, code: SceneCode, side: int) -> np.ndarray:
        """K of each crop, drawn at ``side`` pixels."""
        focal = FILL * side * code[ASSUMED_M][:, 0].cpu().numpy() / self.object.kind.diameter_m
        matrices = np.zeros((len(focal), 3, 3))
        matrices[:, 0, 0] = matrices[:, 1, 1] = focal
        matrices[:, [0, 1], 2] = (side - 1) / 2
        matrices[:, 2, 2] = 1
        return matrices

    def _metres(self, place: Tensor, assumed: Tensor) -> Tensor:
        return torch.cat([place[:, :2] * self.object.kind.diameter_m, place[:, 2:] * assumed], dim=-1)

    @cached_property
    def _surface(self) -> ObjectCoordinateMap:
        return ObjectCoordinateMap(self.object.mesh, CROP_PX // OBJECT_COORDINATES_STRIDE)

    @cached_property
    def _points(self) -> Tensor:
        """Vertices, in diameters."""
        vertices = self.object.mesh.vertices_m
        chosen = np.random.default_rng(0).choice(len(vertices), min(_NUM_POINTS, len(vertices)), replace=False)
        return torch.from_numpy(vertices[chosen] / self.object.kind.diameter_m).float()

    @cached_property
    def _turns(self) -> Tensor:
        """Rotations onto itself, the identity first; their shifts are a few millimetres and left out."""
        info = self.object.kind.info
        return torch.from_numpy(np.stack([pose.rotation for pose in symmetry_poses(info, SYMMETRY_STEP)])).float()


def _grid(look: SingleObjectWorld) -> CellGrid:
    """The cells of a look's images."""
    camera = look.camera
    assert camera.matrix is not None
    here = Pose(np.eye(3), np.zeros(3))
    return CellGrid(look.layout[TRANSLATION], camera.matrix, here, (camera.width, camera.height), on_plane=False)
