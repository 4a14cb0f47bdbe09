"""Which answers of a network can tell whether a runtime computes the same."""

import io

import numpy as np
import pytest
import torch
from curio_train.errors import ExportError
from curio_train.export.graph import Graph, check_images, decided_images, numerically_stable, pixels_of
from curio_train.export.write_model import _golden
from curio_train.networks.templates.quick_trunk import quicken
from curio_train.networks.templates.trunk import Trunk
from curio_train.scene_code import CONFIDENCE, LIGHT, TRANSLATION
from curio_train.worlds.generated.circles import Circles


class _Brighter(torch.nn.Module):
    """Right of the middle if the right half of a picture is brighter: of equal halves rounding decides."""

    def forward(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
        left, right = images.double().chunk(2, dim=3)
        side = torch.where(right.mean((1, 2, 3)) > left.mean((1, 2, 3)), 0.2, -0.2)
        return {TRANSLATION: torch.stack([side, side, 0 * side], dim=1)[:, None].float()}


def test_images_on_which_rounding_decides_can_tell_nothing() -> None:
    graph = Graph(_Brighter(), Circles())
    images = torch.zeros(8, 128, 128, 3, dtype=torch.uint8)
    images[:5, :, 64:] = 100
    assert numerically_stable(graph, images).tolist() == [[True]] * 5 + [[False]] * 3


class _Seldom(torch.nn.Module):
    """Of pictures that are darker than some brightness rounding decides."""

    def __init__(self, least: float) -> None:
        super().__init__()
        self.least = least

    def forward(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
        last_digits = (images[:, 0, 0, 0] * 255).double() - (images[:, 0, 0, 0] * 255).round()
        side = torch.where((images.mean((1, 2, 3)) > self.least) | (last_digits > 0), 0.2, -0.2)
        return {TRANSLATION: torch.stack([side, side, 0 * side], dim=1)[:, None].float()}


def test_where_few_answers_can_tell_more_images_are_drawn() -> None:
    world = Circles()
    first = pixels_of(check_images(world)).mean((1, 2, 3)).sort(descending=True).values
    seldom = Graph(_Seldom(float(first[:2].mean())), world)
    assert numerically_stable(seldom, check_images(world)).sum() == 1
    images, stable = decided_images(seldom, world)
    assert len(images) == len(first)
    assert stable.sum() >= 2
    assert torch.equal(numerically_stable(seldom, images), stable)
    often = decided_images(Graph(_Seldom(0.0), world), world)
    assert torch.equal(often[0], check_images(world))
    assert often[1].all()
    with pytest.raises(ExportError, match=r"8 of the network's 8 answers to check images .*\. Do this"):
        decided_images(Graph(_Seldom(1.0), world), world, "Do this")


class _Likeliest(torch.nn.Module):
    """The likeliest of the cells of a trunk: in a picture of one colour they are equal but for rounding."""

    def __init__(self) -> None:
        super().__init__()
        self.trunk = Trunk.pretrained()

    def forward(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
        cells = self.trunk(images)[1][:, 0, 4:-4, 4:-4].flatten(1)
        return {TRANSLATION: cells.argmax(dim=1)[:, None, None].expand(-1, 1, 3).float()}


@pytest.mark.parametrize("is_quick", [False, True])
def test_features_of_a_trunk_are_jittered(monkeypatch: pytest.MonkeyPatch, is_quick: bool) -> None:
    monkeypatch.setattr("curio_train.export.graph._PIXEL_JITTER", 0.0)
    network = _Likeliest()
    if is_quick:
        quicken(network)
    images = torch.full((2, 128, 128, 3), 90, dtype=torch.uint8)
    assert not numerically_stable(Graph(network, Circles()), images).any()


class _BrighterAndFixed(_Brighter):
    """Of two objects one is where it always is."""

    def forward(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
        moved = super().forward(images)[TRANSLATION]
        return {TRANSLATION: torch.cat([moved, torch.ones_like(moved)], dim=1)}


def test_golden_files_leave_out_what_rounding_decides() -> None:
    graph = Graph(_BrighterAndFixed(), Circles())
    images, stable = torch.zeros(2, 4, 4, 3, dtype=torch.uint8), torch.tensor([[False, False], [False, True]])
    images[1] = 9
    outputs = {TRANSLATION: torch.ones(2, 2, 3), CONFIDENCE: torch.ones(2, 2), LIGHT: torch.ones(2, 3)}
    graph.of_scene = frozenset({LIGHT})
    stored = dict(np.load(io.BytesIO(_golden(images, graph, stable, outputs))))
    assert (stored.pop("image") == 9).all(), "the image with more stable answers"
    assert stored.keys() == {TRANSLATION, CONFIDENCE}, "the light of a scene with unstable answers is left out"
    assert np.isnan(stored[TRANSLATION][0]).all()
    assert (stored[TRANSLATION][1] == 1).all()
    assert np.isnan(stored[CONFIDENCE]).tolist() == [True, False]
    whole = dict(np.load(io.BytesIO(_golden(images, graph, torch.ones_like(stable), outputs))))
    assert whole.keys() == {"image", *outputs}
    assert all(np.isfinite(whole[name]).all() for name in outputs)


def test_each_object_of_an_image_is_judged_by_itself() -> None:
    graph = Graph(_BrighterAndFixed(), Circles())
    images = torch.zeros(8, 128, 128, 3, dtype=torch.uint8)
    images[:1, :, 64:] = 100
    assert numerically_stable(graph, images).tolist() == [[True, True]] + [[False, True]] * 7
    assert numerically_stable(graph, images[1:]).tolist() == [[False, True]] * 7


class _Surer(torch.nn.Module):
    """The surer of two cells that read the same pixel almost alike."""

    def __init__(self, difference: float) -> None:
        super().__init__()
        self.cells = torch.nn.Conv2d(3, 2, 1)
        torch.nn.init.ones_(self.cells.weight)
        assert self.cells.bias is not None
        self.cells.bias.data = torch.tensor([0.0, difference])

    def forward(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
        side = 0.2 * self.cells(images)[:, :, 0, 0].argmax(dim=1).float()
        return {TRANSLATION: torch.stack([side, side, 0 * side], dim=1)[:, None]}


@pytest.mark.parametrize(("difference", "expected"), [(1e-3, 8), (1e-6, 4)])
def test_layers_that_rounding_decides_can_tell_nothing(difference: float, expected: int) -> None:
    """Two cells are moved alike by any pixel, so pixels do not tell; where all is black they differ by all they say."""
    images = torch.full((8, 128, 128, 3), 200, dtype=torch.uint8)
    images[4:] = 0
    assert numerically_stable(Graph(_Surer(difference), Circles()), images).sum() == expected
