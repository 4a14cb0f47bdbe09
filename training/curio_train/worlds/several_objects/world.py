"""The world of a detector for several objects at once: one network, one slot an object.

Only the locator is trained. Poses are read by templates that are drawn of the meshes before training begins, on the
same frozen features.
"""

from collections.abc import Sequence
from pathlib import Path

from torch import nn

from curio_train.networks.base import StageNetwork
from curio_train.networks.several_objects.locator import LocatorNetwork
from curio_train.networks.several_objects.network import ObjectsNetwork
from curio_train.worlds.several_objects.confidence import calibrate
from curio_train.worlds.several_objects.locator_stage import LocatorStage
from curio_train.worlds.several_objects.scenes import ObjectScenes
from curio_train.worlds.single_object.two_stage import TrainingPhotographs, frame_camera, template_geometry
from curio_train.worlds.single_object.world import Object, pose_layout, position_field


class SeveralObjectsWorld(ObjectScenes):
    """Several objects of one camera in six degrees of freedom, each at most once in a frame."""

    photographs: TrainingPhotographs | None
    """Photographs of a scene with the objects; None: there are none."""
    aligns_outlines: bool
    """Whether poses are aligned with the objects' outlines in the end."""

    def __init__(
        self,
        name: str,
        members: Sequence[Object],
        photographs: TrainingPhotographs | None = None,
        model_name: str | None = None,
        *,
        aligns_outlines: bool = False,
    ) -> None:
        """Build the stage; photographs are not read before they are needed.

        Args:
            name: As on the command line.
            members: The objects, each with the slot of its place in this order.
            photographs: Of a scene with the objects.
            model_name: Of exported models; ``name`` unless given.
            aligns_outlines: Whether poses are aligned with the objects' outlines in the end.
        """
        layout = pose_layout(position_field(members[0]), confidence=True, num_slots=len(members))
        super().__init__(name, members, frame_camera(members[0].camera), layout)
        self.photographs, self._model_name = photographs, model_name or name
        self.aligns_outlines = aligns_outlines
        self._stage = LocatorStage(members, self.camera)

    @property
    def model_name(self) -> str:
        """Name of exported models unless the user gives one."""
        return self._model_name

    @property
    def stages(self) -> tuple[LocatorStage]:
        """The locator alone."""
        return (self._stage,)

    @property
    def stage_schedule(self) -> tuple[int, ...]:
        """Every step trains the locator."""
        return (0,)

    def assemble(self, networks: Sequence[StageNetwork]) -> nn.Module:
        """The locator with templates that are still empty."""
        (locator,) = networks
        assert isinstance(locator, LocatorNetwork)
        geometries = [template_geometry(self.camera, member) for member in self.members]
        return ObjectsNetwork(locator, geometries, aligns_outlines=self.aligns_outlines)

    def calibrate_confidence(self, network: nn.Module, cache: Path) -> None:
        """Calibrate the network's confidence on renderings that it was not trained with."""
        assert isinstance(network, ObjectsNetwork)
        calibrate(network, self, cache)
