"""Objects without a background, under several lights at once."""

import curio_train.rendering.renderer as renderer_module
import pytest
import torch
from curio_train.errors import RendererError
from curio_train.rendering.renderer import Renderer

SIZE, COUNT = 64, 8
LIGHTS = torch.tensor([[0.0, -0.5, -0.7], [0.6, 0.1, -0.4], [0.0, 0.0, 0.0]])


@pytest.mark.parametrize("rays", [4_000_000, 20_000], ids=["at once", "in parts"])
def test_cutouts_equal_renderings_over_black_and_white(rays, meshes, draw, camera_matrix, monkeypatch) -> None:
    monkeypatch.setattr(renderer_module, "MAX_RAYS", rays)
    codes = draw(COUNT, 2, 5)
    codes.translation_m[3, :, 0] = 9.0  # nothing is seen of either
    renderer = Renderer([meshes["ring"], meshes["root"]], [0, 1], SIZE, SIZE, ambient=0.3)
    where = codes.rotation, codes.translation_m

    colors, alpha = renderer.cutouts(*where, camera_matrix=camera_matrix, lights=LIGHTS, seed=7)

    black = torch.zeros(COUNT, 3, SIZE, SIZE)
    for light, found in zip(LIGHTS, colors, strict=True):
        over_black, over_white = (
            renderer(*where, camera_matrix=camera_matrix, backgrounds=behind, light=light.expand(COUNT, 3), seed=7)
            for behind in (black, black + 1)
        )
        torch.testing.assert_close(found, over_black, rtol=0, atol=1e-6)
        torch.testing.assert_close(alpha.expand(-1, 3, -1, -1), 1 - (over_white - over_black), rtol=0, atol=1e-6)
    assert (colors[0] - colors[1]).abs().max() > 0.1
    assert alpha[3].max() == 0
    assert alpha[0].max() == 1
    assert ((alpha > 0.2) & (alpha < 0.8)).any()


def test_objects_in_each_others_light_are_refused(meshes, draw, camera_matrix) -> None:
    codes = draw(1, 2, 5)
    renderer = Renderer([meshes["box"]], [0, 0], SIZE, SIZE, ambient=0.3, object_shadows=True)
    with pytest.raises(RendererError, match="each other's light are rendered anew for each light"):
        renderer.cutouts(codes.rotation, codes.translation_m, camera_matrix=camera_matrix, lights=LIGHTS)
