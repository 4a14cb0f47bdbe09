"""Graphs of one image that are run on each image of a batch."""

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
import torch.nn.functional as F
from curio_train.export.image_by_image import image_by_image, inner_graph, of_one_image
from curio_train.export.int8 import rounded_otherwise, to_int8
from curio_train.export.onnx import Tracing, store_half, to_onnx
from torch import nn

SIZE = 32


class Small(nn.Module):
    """Convolutions, one of them with a part of a weight, turned; a mean for each slot, and an answer of the scene."""

    def __init__(self) -> None:
        super().__init__()
        self.first, self.middle, self.last = nn.Conv2d(3, 32, 3), nn.Conv2d(36, 8, 3), nn.Conv2d(8, 4, 3)
        self.few = nn.Conv2d(8, 8, 3)

    def forward(self, image: torch.Tensor, slots: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        pixels = image.permute(0, 3, 1, 2).float() / 255
        weight = self.middle.weight.narrow(1, 4, 32).transpose(2, 3)
        middle = F.conv2d(self.first(pixels).relu(), weight, self.middle.bias).relu()
        seen = self.last(self.few(middle).relu()).mean(dim=(2, 3))
        return seen[:, slots], pixels.mean(dim=(1, 2, 3))


@pytest.fixture(scope="module")
def network() -> Small:
    torch.manual_seed(0)
    network = Small().eval()
    for parameter in network.parameters():
        parameter.data = parameter.data.half().float()
    return network


@pytest.fixture(scope="module")
def model(network: Small) -> onnx.ModelProto:
    return to_onnx(network, SIZE, SIZE, ["of_slots", "of_scene"], Tracing(one_image=True, num_slots=4))


IMAGES = np.random.default_rng(0).integers(0, 255, (3, SIZE, SIZE, 3), np.uint8)


def run(model: onnx.ModelProto, images: np.ndarray, slots: list[int] | None = None) -> list[np.ndarray]:
    onnx.checker.check_model(model)
    session = onnxruntime.InferenceSession(model.SerializeToString())
    return session.run(None, {"image": images} | ({} if slots is None else {"slots": np.array(slots)}))


@pytest.mark.parametrize(("num_images", "slots"), [(1, None), (3, None), (3, [2, 0]), (2, [1])])
def test_any_batch_is_read(network: Small, model: onnx.ModelProto, num_images: int, slots: list[int] | None) -> None:
    images, wanted = IMAGES[:num_images], torch.tensor(slots or [0, 1, 2, 3])
    with torch.no_grad():
        expected = network(torch.from_numpy(images), wanted)
    for found, of_torch in zip(run(model, images, slots), expected, strict=True):
        np.testing.assert_allclose(found, of_torch.numpy(), atol=1e-5)


def test_what_is_put_in_comes_out_again(model: onnx.ModelProto) -> None:
    single = of_one_image(model)
    assert inner_graph(single) is single.graph
    assert of_one_image(single) is single
    assert len(single.graph.node) > 5
    for number, image in enumerate(IMAGES):
        for alone, among in zip(run(single, image[None]), run(model, IMAGES), strict=True):
            np.testing.assert_allclose(alone[0], among[number], atol=1e-6)
    for one, other in zip(run(image_by_image(single), IMAGES), run(model, IMAGES), strict=True):
        np.testing.assert_array_equal(one, other)


def test_weights_inside_are_stored_as_half(model: onnx.ModelProto) -> None:
    half = onnx.ModelProto()
    half.CopyFrom(model)
    store_half(half)
    assert half.ByteSize() < 0.8 * model.ByteSize()
    for one, other in zip(run(half, IMAGES), run(model, IMAGES), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_part_of_a_weight_is_stored_as_it_is_computed_with(model: onnx.ModelProto) -> None:
    graph = inner_graph(model)
    sizes = {tensor.name: list(tensor.dims) for tensor in graph.initializer}
    weights = [sizes[node.input[1]] for node in graph.node if node.op_type == "Conv"]
    assert weights == [[32, 3, 3, 3], [8, 32, 3, 3], [8, 8, 3, 3], [4, 8, 3, 3]]


def test_convolutions_inside_are_quantised(model: onnx.ModelProto, capfd: pytest.CaptureFixture[str]) -> None:
    """That with 288 products a sum; not the first and the last, nor the one with 72."""
    quantised = to_int8(model, torch.from_numpy(IMAGES).permute(0, 3, 1, 2))
    assert capfd.readouterr() == ("", ""), "neither onnxruntime nor its quantiser has advice for users"
    graph = inner_graph(quantised)
    assert any(node.op_type == "QuantizeLinear" for node in graph.node)
    of_int8 = {name for node in graph.node if node.op_type == "DequantizeLinear" for name in node.output}
    assert [node.input[1] in of_int8 for node in graph.node if node.op_type == "Conv"] == [False, True, False, False]
    assert [node.op_type for node in quantised.graph.node] == ["Scan"]
    found, exact = run(quantised, IMAGES)[0], run(model, IMAGES)[0]
    assert 0 < np.abs(found - exact).max() < 0.05
    moved = [np.abs(run(other, IMAGES)[0] - found).max() for other in rounded_otherwise(quantised)]
    assert len(moved) == 6
    assert max(moved) < 0.05
