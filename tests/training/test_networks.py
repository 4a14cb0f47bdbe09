"""The networks are the paper's to the parameter."""

import pytest
import torch
from curio_train.config import ConvStack, NetworkConfig
from curio_train.errors import UsageError
from curio_train.networks.paper.critic import Critic
from curio_train.networks.paper.network import Encoder, PoseNetwork
from curio_train.scene_code import TRANSLATION, Field, Layout
from torch import nn

LAYOUT = Layout((Field(TRANSLATION, 3),))
SMALL = ConvStack((8, 16), (8, 8), (4, 2), (0, 0))


def num_parameters(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_encoder_has_the_papers_number_of_parameters() -> None:
    assert num_parameters(Encoder(NetworkConfig().encoder)) == 2_029_056


@pytest.mark.parametrize("normalisation", ["batch", "instance"])
def test_critic_has_the_papers_number_of_parameters(normalisation: str) -> None:
    assert num_parameters(Critic(NetworkConfig().critic, normalisation)) == 1_883_713


def test_layers_have_the_papers_sizes() -> None:
    sides = []
    encoder = Encoder(NetworkConfig().encoder)
    for layer in encoder.layers:
        layer.register_forward_hook(lambda module, _, out: sides.append(tuple(out.shape[1:])))
    encoder(torch.rand(2, 3, 128, 128))
    assert sides[::3] == [(64, 30, 30), (192, 14, 14), (384, 7, 7), (256, 4, 4), (64, 1, 1)]


def test_critic_returns_unbounded_logits_one_an_image() -> None:
    critic = Critic(NetworkConfig().critic)
    with torch.no_grad():
        critic.layers[-1].bias.fill_(7.0)
    logits = critic(torch.rand(3, 3, 128, 128))
    assert logits.shape == (3,)
    assert logits.max() > 1


def test_critic_judges_with_the_batchs_own_statistics_even_after_training() -> None:
    critic = Critic(NetworkConfig().critic)
    images = torch.rand(4, 3, 128, 128)
    assert torch.equal(critic.train()(images), critic.eval()(images))


def test_other_sizes_are_a_configuration() -> None:
    network = PoseNetwork(LAYOUT, 48, NetworkConfig(encoder=ConvStack((8, 24), (8, 11), (4, 2), (0, 0))))
    assert network(torch.rand(2, 3, 48, 48))[TRANSLATION].shape == (2, 1, 3)
    assert network.heads.trunk[0].in_features == 24


def test_an_image_size_that_leaves_several_pixels_is_refused() -> None:
    with pytest.raises(UsageError, match="leaves 12 pixels a side of an image of 128, expected 1"):
        PoseNetwork(LAYOUT, 128, NetworkConfig(encoder=SMALL))


def test_lists_of_unequal_length_are_refused() -> None:
    with pytest.raises(UsageError, match="equally long"):
        ConvStack((8, 16), (3,), (2, 2), (0, 0))
