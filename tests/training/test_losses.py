"""Loss terms on cases that can be worked out by hand."""

import math
from pathlib import Path

import pytest
import torch
from curio_train.config import NetworkConfig
from curio_train.learning.losses import critic_loss, curiosity_loss, frozen, gradient_penalty, image_loss
from curio_train.learning.sleep import sleep_codes
from curio_train.metrics.assignment import scene_error
from curio_train.networks.paper.critic import Critic
from curio_train.scene_code import COLOR, CONFIDENCE, ROTATION_6D, TRANSLATION, Field, Layout, SceneCode
from curio_train.worlds.base import Camera, ImageSource, Split, World
from torch import Tensor

LAYOUT = Layout(
    (
        Field(TRANSLATION, 3, activation="tanh", lower=(-1, -1, -1), upper=(1, 1, 1)),
        Field(CONFIDENCE, 1, activation="sigmoid", lower=(0,), upper=(1,)),
    ),
    num_slots=2,
)


def scene(*objects: tuple[float, float]) -> dict[str, Tensor]:
    """One image of objects given as (x, confidence)."""
    return {
        TRANSLATION: torch.tensor([[[x, 0.0, 0.0] for x, _ in objects]]),
        CONFIDENCE: torch.tensor([[[confidence] for _, confidence in objects]]),
    }


def test_image_loss_sums_over_pixels_and_channels_and_averages_over_images() -> None:
    black = torch.zeros(2, 3, 4, 4)
    one_grey = torch.stack([torch.full((3, 4, 4), 0.5), torch.zeros(3, 4, 4)])
    assert image_loss(one_grey, black).item() == 3 * 4 * 4 * 0.25 / 2


@pytest.mark.parametrize(
    ("predicted", "expected"),
    [
        (scene((0.5, 1.0), (-0.5, 0.0)), 0.0),
        (scene((-0.5, 0.0), (0.5, 1.0)), 0.0),  # slots have no order
        (scene((0.1, 1.0), (-0.5, 0.3)), 0.4 / 2 + 0.3**2),  # a position off by 0.4 of a range of 2; a surplus of 0.3
        (scene((0.5, 0.7), (-0.5, 0.0)), 0.3),
    ],
)
def test_supervised_loss_is_eq_1(predicted: SceneCode, expected: float) -> None:
    true = scene((0.5, 1.0), (0.0, 0.0))
    assert scene_error(LAYOUT, predicted, true, ((0, 1),)).item() == pytest.approx(expected, abs=1e-6)


def test_supervised_loss_leads_each_prediction_to_its_own_object() -> None:
    true = scene((0.5, 1.0), (-0.5, 1.0))
    predicted = scene((-0.4, 1.0), (0.3, 1.0))
    predicted[TRANSLATION].requires_grad_()
    scene_error(LAYOUT, predicted, true, ((0, 1),)).mean().backward()
    assert predicted[TRANSLATION].grad[0, :, 0].tolist() == pytest.approx([0.5, -0.5])


def test_adversarial_losses_are_cross_entropies_of_logits() -> None:
    logits = {"data": 2.0, "render": -1.0}
    data, render = torch.zeros(3, 1), torch.ones(3, 1)

    def judge(images: Tensor) -> Tensor:
        return torch.where(images[:, 0] == 0, logits["data"], logits["render"])

    belief = {name: 1 / (1 + math.exp(-logit)) for name, logit in logits.items()}
    assert curiosity_loss(judge, render).item() == pytest.approx(-math.log(belief["render"]))
    expected = -math.log(belief["data"]) - math.log(1 - belief["render"])
    assert critic_loss(judge, data, render).item() == pytest.approx(expected)


def test_gradient_penalty_of_a_linear_critic_is_half_its_squared_slope() -> None:
    slope = torch.randn(3, 4, 4)
    penalty = gradient_penalty(lambda images: (images * slope).sum((1, 2, 3)), torch.rand(5, 3, 4, 4))
    assert penalty.item() == pytest.approx(slope.square().sum().item() / 2, rel=1e-5)


def test_curiosity_moves_the_images_and_the_critics_loss_the_critic_alone() -> None:
    critic = Critic(NetworkConfig().critic)
    images, rendered = torch.rand(2, 3, 128, 128), torch.rand(2, 3, 128, 128, requires_grad=True)
    with frozen(critic):
        loss = curiosity_loss(critic, rendered)
    loss.backward()
    assert rendered.grad.abs().max() > 0
    assert all(parameter.grad is None for parameter in critic.parameters())
    rendered.grad = None
    critic_loss(critic, images, rendered).backward()
    assert rendered.grad is None
    assert all(parameter.grad is not None for parameter in critic.parameters())


class Tumbling(World):
    """Coloured objects with rotation: bounds, a linear field, a field with a form of its own. Never rendered here."""

    name = "tumbling"
    layout = Layout(
        (
            Field(TRANSLATION, 3, activation="linear", lower=(-1, -1, -1), upper=(1, 1, 1)),
            Field(COLOR, 3, activation="sigmoid", lower=(0, 0, 0), upper=(1, 1, 1)),
            Field(ROTATION_6D, 6),
        )
    )
    camera = Camera(128, 128)
    objects = ()

    def sample(self, count: int, seed: tuple[int, ...]) -> dict[str, Tensor]:
        identity = torch.tensor([1.0, 0, 0, 0, 1, 0]).expand(count, 1, 6)
        return {TRANSLATION: torch.full((count, 1, 3), 9.0), COLOR: torch.zeros(count, 1, 3), ROTATION_6D: identity}

    def render(self, code: SceneCode, backgrounds: Tensor | None = None) -> Tensor:
        raise AssertionError("no test here renders")

    def source(self, split: Split, seed: int, *, with_code: bool, cache: Path) -> ImageSource:
        raise AssertionError("no test here needs images")


def raw_code(num: int) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(1)
    sizes = {TRANSLATION: 3, COLOR: 3, ROTATION_6D: 6}
    return {name: torch.randn(num, 1, size, generator=generator).requires_grad_() for name, size in sizes.items()}


def test_sleep_codes_are_valid_free_of_gradient_and_repeatable() -> None:
    code = sleep_codes(Tumbling(), raw_code(64), noise=3.0, drawn=0.0, seed=(1, 2))
    assert not any(value.requires_grad for value in code.values())
    assert code[COLOR].min() >= 0
    assert code[COLOR].max() <= 1
    x, y = code[ROTATION_6D].split(3, dim=-1)
    assert torch.allclose(x.norm(dim=-1), torch.ones(64, 1), atol=1e-5)
    assert (x * y).sum(-1).abs().max() < 1e-5
    again = sleep_codes(Tumbling(), raw_code(64), noise=3.0, drawn=0.0, seed=(1, 2))
    other = sleep_codes(Tumbling(), raw_code(64), noise=3.0, drawn=0.0, seed=(1, 3))
    assert torch.equal(code[TRANSLATION], again[TRANSLATION])
    assert not torch.equal(code[TRANSLATION], other[TRANSLATION])


def test_sleep_codes_stray_from_the_predictions_by_the_noise_and_no_more() -> None:
    raw = raw_code(4000)
    code = sleep_codes(Tumbling(), raw, noise=0.2, drawn=0.0, seed=(0,))
    strayed = (code[TRANSLATION] - raw[TRANSLATION]).std().item()
    assert strayed == pytest.approx(0.2 / math.sqrt(3), rel=0.05)  # each code's share of the noise is uniform
    still = sleep_codes(Tumbling(), raw, noise=0.0, drawn=0.0, seed=(0,))
    assert torch.equal(still[TRANSLATION], raw[TRANSLATION])


def test_the_drawn_share_of_sleep_codes_comes_from_the_worlds_range() -> None:
    code = sleep_codes(Tumbling(), raw_code(10), noise=0.1, drawn=0.3, seed=(0,))
    assert (code[TRANSLATION][..., 0] == 9.0).flatten().tolist() == [True] * 3 + [False] * 7
