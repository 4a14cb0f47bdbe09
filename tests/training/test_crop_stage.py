"""The crop-pose stage in an exported graph: it is marked there, and alone it says what the network says of a crop."""

import json

import numpy as np
import pytest
import torch
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.crop import cut_crop
from curio_serve.models.model import from_bytes
from curio_serve.models.stages.crop_stage import CROP_STAGE_KEY, CropStage, CropStageNote
from curio_train.config import NetworkConfig
from curio_train.export.graph import Graph
from curio_train.export.onnx import put_spec, store_half
from curio_train.export.spec import model_spec
from curio_train.export.stages import traced
from curio_train.networks.two_stage.network import TwoStageNetwork
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.world import Object


@pytest.fixture(scope="module")
def exported(brick: Object) -> tuple[TwoStageNetwork, bytes]:
    torch.manual_seed(0)
    world = TwoStageWorld("linemod", brick)
    network = world.assemble([stage.network(NetworkConfig()) for stage in world.stages]).eval()
    assert isinstance(network, TwoStageNetwork)
    names = list(world.outputs.from_code(network(torch.zeros(1, 3, 480, 640))))
    model = traced(Graph(network, world), network, world.camera, names)
    store_half(model)
    put_spec(model, model_spec(world, "brick"))
    assert [value.name for value in model.graph.output] == names
    return network, model.SerializeToString()


@torch.no_grad()
def test_the_stage_alone_says_of_a_crop_what_the_network_says(exported: tuple[TwoStageNetwork, bytes]) -> None:
    network, data = exported
    model = from_bytes(data, "brick.onnx")
    assert model.crop_stage is not None
    random = np.random.default_rng(0)
    pixels = np.kron(random.integers(0, 255, (30, 40, 3)), np.ones((16, 16, 1))).astype(np.uint8)
    camera = PinholeCamera(np.asarray(model.camera.matrix))
    found = model.crop_stage.read(pixels, camera, np.array([0.1, -0.05, 0.9]), model.camera.focal_lengths[0])
    position = torch.tensor([[[0.1, -0.05, 0.9]]]) * torch.tensor([1 / 1.09, 1.09])[:, None]
    poses, _ = network._crop_poses(torch.from_numpy(pixels).permute(2, 0, 1)[None].float() / 255, position)
    expected = poses["translation_m"][:, 0].numpy()
    np.testing.assert_allclose(found.translation_m, expected.mean(axis=0), rtol=0.02, atol=2e-3)
    np.testing.assert_allclose(found.light, poses["light"].mean(dim=0), atol=5e-3)


def test_a_crop_shows_what_its_camera_sees() -> None:
    """A pixel of the frame lies in the crop where the homography puts it, with and without distortion."""
    pixels = np.zeros((240, 320, 3), np.uint8)
    pixels[98:103, 198:203] = 255
    for distortion in ((), (0.0, 0.0, 0.0, 0.0), (1e-9, 0.0, 0.0, 0.0)):
        camera = PinholeCamera(np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]), distortion)
        crop = cut_crop(pixels, camera, np.eye(3), 150.0, 64, 300.0)
        rows, columns = np.nonzero(crop[..., 0] > 128)
        # At half the focal length the offset from the principal point halves.
        assert (columns.mean(), rows.mean()) == pytest.approx((31.5 + 20, 31.5 - 10), abs=0.6)


def test_a_note_of_tensors_that_need_more_than_crops_is_refused(exported: tuple[TwoStageNetwork, bytes]) -> None:
    from curio_serve.errors import ModelError
    from curio_serve.models.spec import read_metadata

    _, data = exported
    note = CropStageNote.parse(read_metadata(data, CROP_STAGE_KEY), "brick.onnx")
    wrong = CropStageNote(**{**note.__dict__, "tensors": {**note.tensors, "crops": "image_of_nothing"}})
    with pytest.raises(ModelError, match=r"depend on 'image', which is none of its inputs .image_of_nothing."):
        CropStage(data, wrong, "brick.onnx", ())
    assert json.loads(read_metadata(data, CROP_STAGE_KEY))["side_px"] == 64
