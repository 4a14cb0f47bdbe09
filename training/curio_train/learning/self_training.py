"""Self-training: when photographs get pseudo-labels, and how they are mixed into the synthetic batches.

``refinement.pseudo_labels`` and, for several objects, ``refinement.scene_labels`` say how the labels are made.
"""

from pathlib import Path

import torch
from torch import Tensor, nn

from curio_train.networks.several_objects.network import ObjectsNetwork
from curio_train.networks.two_stage.network import TwoStageNetwork
from curio_train.refinement.photographed_confidence import (
    calibrate_by,
    calibrate_by_agreement,
    calibrate_parts_by_agreement,
    read_by_others,
)
from curio_train.refinement.pseudo_labels import PseudoLabels
from curio_train.refinement.scene_labels import SceneLabels
from curio_train.scene_code import SceneCode
from curio_train.templates.photographed import learn_appearance
from curio_train.worlds.base import StagedWorld, World
from curio_train.worlds.several_objects.confidence import calibrate
from curio_train.worlds.several_objects.world import SeveralObjectsWorld
from curio_train.worlds.single_object.two_stage import TwoStageWorld

ROUNDS, ROUNDS_OF_PRETRAINED = (0.6, 0.8), (0.2, 0.5, 0.8)
"""Fractions of the budget after which a pseudo-labelling round is due: late, when the network's poses are good enough;
sooner for networks that began with trained weights (``--init``)."""

LARGEST_SHARE = 0.15
"""Largest share of a budget of minutes that one round may take."""


class SelfTraining:
    """Pseudo-labels of a world's photographs, for the last stage of its network."""

    def __init__(
        self,
        network: nn.Module,
        world: World,
        fraction: float,
        device: torch.device,
        *,
        pretrained: bool = False,
        minutes: float | None = None,
    ) -> None:
        """Begin without any.

        Args:
            network: All stages in one.
            world: Has the photographs.
            fraction: Of the last stage's images that are to be photographs; 0 never labels any.
            device: Of the network.
            pretrained: The network began with trained weights.
            minutes: Budget of the training; None: it is not one of time.
        """
        self._world, self._network, self._fraction, self._device = world, network, fraction, device
        self._rounds = ROUNDS_OF_PRETRAINED if pretrained else ROUNDS
        self._seconds = None if minutes is None else LARGEST_SHARE * 60 * minutes
        self._labels: PseudoLabels | SceneLabels | None = None
        self._num_rounds = 0

    def is_due(self, spent: float) -> bool:
        """Whether a round is due after this fraction of the budget; a resumed run repeats the last one."""
        return self._fraction > 0 and self._rounds_until(spent) > self._num_rounds

    def run_round(self, spent: float) -> None:
        """Pseudo-labelling round; if it accepts no pose, the labels of the round before stay.

        Raises:
            DataError: A photograph cannot be read, or is not of the camera's size.
        """
        self._num_rounds = self._rounds_until(spent)
        self._network.eval()
        self._labels = self._labels_of_photographs() or self._labels
        self._network.train()

    def finish(self, cache: Path) -> str:
        """Once the network is trained, let its templates look as photographs do, and calibrate its confidence.

        Args:
            cache: Folder of the image sets that worlds draw once.

        Returns:
            What calibrates the confidence of parts of one's own, for the user; else nothing.

        Raises:
            DataError: The backgrounds cannot be read.
        """
        told = ""
        world, network, labels = self._world, self._network.cpu(), self._labels  # as the frames that it reads here
        if isinstance(labels, SceneLabels) and isinstance(world, SeveralObjectsWorld):
            assert isinstance(network, ObjectsNetwork)
            evidence = read_by_others(network, world, labels)
            learn_appearance(network, labels.frames, labels.poses)
            calibrate(network, world, cache, by_heat_map=True)
            calibrate_by(network, evidence)
        elif isinstance(world, StagedWorld):
            world.calibrate_confidence(network, cache)
            # Without outlines wrong reads agree as often as right ones (docs/experiments/captures.md).
            if isinstance(world, TwoStageWorld) and world.aligns_outlines:
                assert isinstance(network, TwoStageNetwork)
                told = calibrate_by_agreement(network, world)
            elif isinstance(world, SeveralObjectsWorld) and world.aligns_outlines:
                assert isinstance(network, ObjectsNetwork)
                told = calibrate_parts_by_agreement(network, world)
        network.to(self._device)
        return told

    def mix_in(self, code: SceneCode, images: Tensor, seed: tuple[int, ...]) -> tuple[dict[str, Tensor], Tensor]:
        """The last stage's codes and images with the first ones replaced by pseudo-labelled photographs, or crops.

        Args:
            code: Of the renderings.
            images: The renderings [batch, 3, height, width].
            seed: Decides which photographs are drawn.
        """
        if self._labels is None:
            return dict(code), images
        num = round(self._fraction * len(images))
        if num == 0:
            return dict(code), images
        labels, crops = self._labels.draw(num, seed)
        mixed = {name: torch.cat([code[name][num:], value.to(images.device)]) for name, value in labels.items()}
        return mixed, torch.cat([images[num:], crops.to(images)])

    def _labels_of_photographs(self) -> PseudoLabels | SceneLabels | None:
        if isinstance(self._world, SeveralObjectsWorld):
            return SceneLabels.from_photographs(self._world, self._predict, self._seconds)
        return PseudoLabels.from_photographs(self._world, self._predict, self._seconds)

    def _rounds_until(self, spent: float) -> int:
        return sum(spent >= fraction for fraction in self._rounds)

    @torch.no_grad()
    def _predict(self, images: Tensor) -> dict[str, Tensor]:
        return {name: value.cpu() for name, value in self._network(images.to(self._device)).items()}
