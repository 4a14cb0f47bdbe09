import numpy as np
import pytest
import torch
from curio_train.config import NetworkConfig
from curio_train.networks.attention import LATENT, AttentionEncoder
from curio_train.networks.pose import PoseNetwork
from curio_train.scene_code import TRANSLATION, Field, Layout


def blob(x: float, y: float, side: int = 64) -> torch.Tensor:
    """A bright spot on black; x and y −1 to 1 from edge to edge."""
    axis = (torch.arange(side) + 0.5) * (2 / side) - 1
    return torch.exp(-((axis - x).square()[None, :] + (axis - y).square()[:, None]) / 0.005).expand(3, -1, -1)


def test_place_is_where_attention_falls():
    """Attention that grows with brightness must report the spot's place: x across, y down, −1 and 1 at the edges."""
    encoder = AttentionEncoder().eval()
    places = [(-0.5, 0.25), (0.5, 0.25), (0.0, -0.75)]
    images = torch.stack([blob(x, y) for x, y in places])
    with torch.no_grad():
        for layer in encoder.layers:
            if isinstance(layer, torch.nn.Conv2d):
                layer.weight.zero_()
                layer.bias.zero_()
                middle = layer.kernel_size[0] // 2
                layer.weight[0, 0, middle, middle] = 1.0
        encoder.attention.weight.zero_()
        encoder.attention.weight[0, 0] = 50.0
        found = encoder(images)[:, LATENT:]
    assert found.numpy() == pytest.approx(np.array(places), abs=0.05)


def test_latent_and_place_have_the_promised_size():
    assert AttentionEncoder()(torch.rand(2, 3, 96, 96)).shape == (2, LATENT + 2)


@pytest.mark.parametrize("activation", ["linear", "tanh", "perspective"])
def test_an_untrained_network_starts_from_the_place_it_sees(activation):
    """A share of the range goes in and, the branch silenced, the same share of the range comes out."""
    field = Field(TRANSLATION, 3, activation=activation, lower=(-0.4, -0.2, 0.5), upper=(0.4, 0.2, 2.0))
    heads = PoseNetwork(Layout((field,)), 64, NetworkConfig(reading="attention")).heads
    last = heads.branches[TRANSLATION][-1]
    torch.nn.init.zeros_(last.weight)
    torch.nn.init.zeros_(last.bias)
    latent = torch.zeros(1, LATENT + 2)
    latent[0, -2:] = torch.tensor([0.5, -0.25])
    position = heads(latent)[TRANSLATION][0, 0]
    lateral = position[:2] / position[2] if activation == "perspective" else position[:2]
    assert lateral.tolist() == pytest.approx([0.2, -0.05], abs=1e-5)


def test_gradient_reaches_every_weight():
    layout = Layout((Field(TRANSLATION, 3, lower=(-1.0,) * 3, upper=(1.0,) * 3),))
    network = PoseNetwork(layout, 64, NetworkConfig(reading="attention"))
    network(torch.rand(4, 3, 64, 64))[TRANSLATION].square().sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in network.parameters())
