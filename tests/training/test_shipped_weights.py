"""Shipped weights fit the networks of this version, which give the golden answers that were exported with them."""

from pathlib import Path

import numpy as np
import pytest
import torch
from curio_train.camera import Intrinsics
from curio_train.config import NetworkConfig
from curio_train.data.backgrounds import ClutterBackgrounds
from curio_train.export.graph import Graph
from curio_train.exported_model import ExportedModel
from curio_train.meshes.shapes import chair
from curio_train.scene_code import TRANSLATION
from curio_train.worlds.base import ObjectKind
from curio_train.worlds.several_objects.world import SeveralObjectsWorld
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.world import Object
from safetensors.torch import load_file

VERSIONS = sorted((Path(__file__).parents[2] / "models").glob("*/[0-9]*"))
SEVERAL = [version for version in VERSIONS if version.parent.name.startswith("lmo")]
"""Models of several objects, whose templates are in the graph alone."""
SINGLE = [version for version in VERSIONS if version not in SEVERAL]
MESH = chair(0.1)  # only rendering would need the object's own


def described_objects(model: ExportedModel) -> list[Object]:
    """The objects that a model's specification describes, with another mesh."""
    spec = model.spec
    camera = spec.camera
    depth = next((field.lower[2], field.upper[2]) for field in spec.fields if field.name == TRANSLATION)
    intrinsics = Intrinsics(np.reshape(camera.camera_matrix, (3, 3)), camera.width, camera.height)
    pool = np.zeros((1, camera.height, camera.width, 3), np.uint8)
    return [
        Object(
            ObjectKind(found.name, (slot,), found.diameter_m, MESH.box_corners_m, found.mesh_sha256),
            MESH,
            intrinsics,
            *depth,
            lambda _: ClutterBackgrounds(pool),
        )
        for slot, found in enumerate(spec.objects)
    ]


def described_world(model: ExportedModel) -> TwoStageWorld:
    """The world of one object that a model's specification describes."""
    (one,) = described_objects(model)
    return TwoStageWorld(model.spec.world, one)


@pytest.mark.parametrize("version", VERSIONS, ids=lambda version: version.parent.name)
def test_the_graph_gives_its_golden_answer(version: Path) -> None:
    golden = dict(np.load(version / "golden.npz"))
    found = ExportedModel.open(version / "model.onnx")(torch.from_numpy(golden.pop("image"))[None])
    assert {"translation_m", "rotation", "confidence"} <= golden.keys() <= found.keys()
    for name, expected in golden.items():
        known = ~np.isnan(expected)  # the others are decided by rounding
        assert known.mean() > 0.5
        np.testing.assert_allclose(found[name][0].numpy()[known], expected[known], atol=5e-3, err_msg=name)


@pytest.mark.parametrize("version", SEVERAL, ids=lambda version: version.parent.name)
def test_weights_fit_the_locator(version: Path) -> None:
    members = described_objects(ExportedModel.open(version / "model.onnx"))
    assert len(members) == 8
    (stage,) = SeveralObjectsWorld("linemod", members).stages
    built = stage.network(NetworkConfig()).state_dict()
    weights = {
        name.removeprefix("locator."): value for name, value in load_file(version / "weights.safetensors").items()
    }
    assert {name: value.shape for name, value in weights.items()} == {name: v.shape for name, v in built.items()}


@pytest.mark.parametrize("version", SINGLE, ids=lambda version: version.parent.name)
def test_weights_fit_and_give_the_golden_answer(version: Path) -> None:
    world = described_world(ExportedModel.open(version / "model.onnx"))
    network = world.assemble([stage.network(NetworkConfig()) for stage in world.stages])
    weights, built = load_file(version / "weights.safetensors"), network.state_dict()
    assert {name: value.shape for name, value in weights.items()} == {name: v.shape for name, v in built.items()}
    network.load_state_dict(weights)
    golden = dict(np.load(version / "golden.npz"))
    with torch.no_grad():
        found = Graph(network.eval(), world).outputs(torch.from_numpy(golden.pop("image"))[None])
    assert found.keys() == golden.keys()
    for name, expected in golden.items():
        np.testing.assert_allclose(found[name][0].numpy(), expected, atol=5e-3, err_msg=name)


def test_there_are_shipped_models() -> None:
    assert {version.parent.name for version in VERSIONS} == {"ape", "lmo"}
