"""Worlds of two-stage detectors: localisation in the whole frame, then pose and light in a crop.

On whole frames a full rotation is slow to learn even with labels; on crops it takes minutes. So each stage is a world
of its own, with its own images and code, and the training steps alternate between them. Crops are rendered directly, by
a virtual crop camera that looks at the object: training crops no frames.

Confidence is the probability that ADD is below a tenth of the diameter.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from torch import nn

from curio_train.camera import Intrinsics
from curio_train.data.photographs import UnlabelledPhotographs
from curio_train.networks.base import StageNetwork
from curio_train.networks.outline_alignment import OutlineAlignment
from curio_train.networks.templates.geometry import Geometry, num_views
from curio_train.networks.two_stage.network import Optics, TwoStageNetwork
from curio_train.worlds.base import Camera
from curio_train.worlds.single_object.confidence import calibrate
from curio_train.worlds.single_object.crop_pose_stage import CROP_PX, FILL, CropPoseStage
from curio_train.worlds.single_object.localisation_stage import LOCALISATION_STRIDE, LocalisationStage
from curio_train.worlds.single_object.viewpoints import Exposure
from curio_train.worlds.single_object.world import Object, SingleObjectWorld, pose_layout, position_field, resized

LONGEST_SIDE_PX = 640
STAGE_SCHEDULE, STAGE_SCHEDULE_IN_KNOWN_SCENE = (0, 1, 1), (0, 1, 1, 1, 1)
"""Stage that each step trains: rotation takes longer than position, most of all before a known background."""


class TrainingPhotographs(Protocol):
    """Photographs of a world's object."""

    def paths(self) -> Sequence[Path]:
        """Files of all photographs.

        Raises:
            DataError: The folder of photographs cannot be read.
        """

    def unlabelled_paths(self) -> Sequence[Path]:
        """Files of the photographs that a network may learn from.

        Raises:
            DataError: The folder of photographs cannot be read.
        """

    def unlabelled(self) -> UnlabelledPhotographs:
        """The photographs that a network may learn from, and their cameras.

        Raises:
            DataError: The folder of photographs cannot be read.
            CameraError: The file of camera poses cannot be used.
        """


class TwoStageWorld(SingleObjectWorld):
    """One object anywhere in a frame, detected in two stages."""

    photographs: TrainingPhotographs | None
    """Photographs of the object; None: there are none."""
    aligns_outlines: bool
    """Whether poses are aligned with the object's outline in the end."""

    def __init__(
        self,
        name: str,
        object_: Object,
        photographs: TrainingPhotographs | None = None,
        *,
        aligns_outlines: bool = False,
    ) -> None:
        """Build the stages; photographs are not read before they are needed.

        Args:
            name: As on the command line.
            object_: What is detected.
            photographs: Of it.
            aligns_outlines: Whether poses are aligned with the object's outline in the end.
        """
        camera = frame_camera(object_.camera)
        layout = pose_layout(position_field(object_), confidence=True, color=object_.unpainted)
        super().__init__(name, object_, camera, layout)
        self.photographs, self.aligns_outlines = photographs, aligns_outlines
        self._stages = LocalisationStage(object_, camera), CropPoseStage(object_)

    @property
    def stages(self) -> tuple[LocalisationStage, CropPoseStage]:
        """Localisation in the whole frame, pose in the crop."""
        return self._stages

    @property
    def stage_schedule(self) -> tuple[int, ...]:
        """One step for localisation, then several for the crop pose."""
        return STAGE_SCHEDULE_IN_KNOWN_SCENE if self.object.known_scene else STAGE_SCHEDULE

    @property
    def exposure(self) -> Exposure:
        """The localisation stage's range of exposures."""
        return self.stages[0].exposure

    def assemble(self, networks: Sequence[StageNetwork]) -> nn.Module:
        """Both stages as one network."""
        localisation, crop_pose = networks
        assert self.camera.matrix is not None
        optics = Optics(
            self.camera.matrix, self.object.kind.diameter_m, self.object.near_m, LOCALISATION_STRIDE, CROP_PX, FILL
        )
        directions = num_views(self.object.seen_from_any_side)
        outline = OutlineAlignment(directions) if self.aligns_outlines else None
        return TwoStageNetwork(localisation, crop_pose, optics, outline)

    def calibrate_confidence(self, network: nn.Module, cache: Path) -> None:
        """Calibrate the network's confidence on renderings that it was not trained with."""
        assert isinstance(network, TwoStageNetwork)
        calibrate(network, self, cache)


def frame_camera(frame: Intrinsics) -> Camera:
    """The canonical camera: the frame's own, at most 640 pixels long, in whole pixels of the localisation stage."""
    scale = min(1.0, LONGEST_SIDE_PX / max(frame.width, frame.height))
    step = 2 * LOCALISATION_STRIDE
    return resized(frame, step * round(frame.width * scale / step), step * round(frame.height * scale / step))


def template_geometry(camera: Camera, object_: Object) -> Geometry:
    """How templates look at an object in a camera's frames; the camera has K."""
    assert camera.matrix is not None
    return Geometry(
        camera.matrix,
        camera.width,
        camera.height,
        object_.kind.diameter_m,
        object_.near_m,
        object_.far_m,
        any_side=object_.seen_from_any_side,
    )
