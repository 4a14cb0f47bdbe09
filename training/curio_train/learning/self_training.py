"""When photographs are read for self-training, and how they come among the renderings: see ``pseudo_labels``."""

import torch
from torch import Tensor, nn

from curio_train.refinement.pseudo_labels import PseudoLabels
from curio_train.scene_code import SceneCode
from curio_train.worlds.base import World

ROUNDS, ROUNDS_OF_PRETRAINED = (0.6, 0.8), (0.2, 0.5, 0.8)
"""Shares of the budget after which photographs are read: late, when what is read is worth it, and once more; sooner by
networks that began as trained ones (``--init``)."""


class SelfTraining:
    """The photographs of a world as its network reads them, for the last look."""

    def __init__(
        self, network: nn.Module, world: World, share: float, device: torch.device, *, trained: bool = False
    ) -> None:
        """Begin without any.

        Args:
            network: All looks in one.
            world: What it learns.
            share: Of the last look's images that are to be photographs.
            device: Of the network.
            trained: The network began as one that reads already.
        """
        self._world, self._network, self._share, self._device = world, network, share, device
        self._studies = ROUNDS_OF_PRETRAINED if trained else ROUNDS
        self._lessons: PseudoLabels | None = None
        self._num_studies = 0

    def is_due(self, progress: float) -> bool:
        """Whether to read photographs, after this share of the budget; a run that was interrupted reads them anew."""
        return self._share > 0 and sum(progress >= share for share in self._studies) > self._num_studies

    def study(self, progress: float) -> None:
        """Read them; where nothing is found, what was found before stays.

        Raises:
            DataError: A photograph cannot be read, or is not of the camera's size.
        """
        self._num_studies = sum(progress >= share for share in self._studies)
        self._network.eval()
        self._lessons = PseudoLabels.from_photographs(self._world, self._read) or self._lessons
        self._network.train()

    def among(self, code: SceneCode, images: Tensor, seed: tuple[int, ...]) -> tuple[dict[str, Tensor], Tensor]:
        """Codes and images of the last look, the first of which have made room for photographs."""
        if self._lessons is None:
            return dict(code), images
        read, crops = self._lessons.draw(round(self._share * len(images)), seed)
        num = len(crops)
        mixed = {name: torch.cat([code[name][num:], value.to(images.device)]) for name, value in read.items()}
        return mixed, torch.cat([images[num:], crops.to(images)])

    @torch.no_grad()
    def _read(self, images: Tensor) -> dict[str, Tensor]:
        return {name: value.cpu() for name, value in self._network(images.to(self._device)).items()}
