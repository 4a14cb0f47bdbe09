"""The heads follow the layout: counts, shapes, rows, activations."""

import pytest
import torch
from curio_train.networks.paper.network import Heads
from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, TRANSLATION, YAW, Field, Layout

CIRCLES = Layout((Field(TRANSLATION, 3),))
LIGHT_WORLD = Layout(
    (
        Field(TRANSLATION, 3, activation="linear", lower=(-1, -1, 2), upper=(1, 1, 6)),
        Field(YAW, 2, activation="tanh", lower=(-1, -1), upper=(1, 1)),
        Field(COLOR, 3, activation="sigmoid", lower=(0, 0, 0), upper=(1, 1, 1)),
        Field(CONFIDENCE, 1, activation="sigmoid", lower=(0,), upper=(1,)),
        Field(LIGHT, 2, per_object=False),
    ),
    num_slots=10,
)


@pytest.mark.parametrize(("layout", "count"), [(CIRCLES, 4_387), (LIGHT_WORLD, 34_123)])
def test_number_of_parameters(layout: Layout, count: int) -> None:
    assert sum(p.numel() for p in Heads(layout).parameters()) == count


def read(heads: Heads, latent: torch.Tensor) -> dict[str, torch.Tensor]:
    return heads.layout.activate(heads.raw(latent))


def test_code_fits_the_layout_and_its_ranges() -> None:
    code = read(Heads(LIGHT_WORLD), 100 * torch.randn(5, 64))
    LIGHT_WORLD.check(code)
    for name in (YAW, COLOR, CONFIDENCE):
        field = LIGHT_WORLD[name]
        assert code[name].min() >= min(field.lower)
        assert code[name].max() <= max(field.upper)


def test_linear_positions_are_unbounded_and_start_in_the_middle_of_the_range() -> None:
    heads = Heads(LIGHT_WORLD)
    assert read(heads, 1000 * torch.ones(1, 64))[TRANSLATION].abs().max() > 6
    for parameter in heads.parameters():
        torch.nn.init.zeros_(parameter)
    assert torch.equal(read(heads, torch.randn(1, 64))[TRANSLATION][0, 3], torch.tensor([0.0, 0.0, 4.0]))


def test_each_slot_has_its_own_features_of_the_latent_code() -> None:
    heads = Heads(Layout((Field(TRANSLATION, 3),), num_slots=4))
    before = read(heads, torch.ones(1, 64))[TRANSLATION]
    with torch.no_grad():
        heads.trunk[0].bias[64:96] += 10.0  # the rows of slot 2
    changed = (read(heads, torch.ones(1, 64))[TRANSLATION] != before).any(-1)[0]
    assert changed.tolist() == [False, False, True, False]


def test_light_does_not_pass_through_the_object_rows() -> None:
    heads = Heads(LIGHT_WORLD)
    before = read(heads, torch.ones(1, 64))
    with torch.no_grad():
        heads.trunk[0].weight.mul_(2)
    after = read(heads, torch.ones(1, 64))
    assert torch.equal(after[LIGHT], before[LIGHT])
    assert not torch.equal(after[TRANSLATION], before[TRANSLATION])
