"""Gloss, grain, bumps, shadows on itself and a second light: what each does to an image, and to gradients."""

from collections.abc import Callable, Mapping

import numpy as np
import pytest
import torch
import trimesh
from curio_train.meshes.meshes import Mesh
from curio_train.rendering.materials import APPEARANCE_SIZE, NUM_WAVES, finishes, random_appearances
from curio_train.rendering.renderer import Renderer
from stock.gradient_check import central_differences, cosine, gradients
from torch import Tensor

SIZE = 48
MATRIX = np.array([[70.0, 0, 23.5], [0, 70.0, 23.5], [0, 0, 1]])
SHADOW = 6  # of a finish's values
Draw = Callable[..., Tensor]


def drawer(mesh: Mesh, light: tuple[float, float, float], ambient: float = 0.1) -> Draw:
    """Draws the mesh from half a metre away, straight on, with a finish or none."""
    renderer = Renderer([mesh], [0], SIZE, SIZE, ambient=ambient)

    def draw(finish: Tensor | None = None) -> Tensor:
        return renderer(
            torch.eye(3)[None, None],
            torch.tensor([[[0.0, 0.0, 0.5]]]),
            camera_matrix=MATRIX,
            backgrounds=torch.zeros(1, 3, SIZE, SIZE),
            light=torch.tensor([light]),
            color=torch.full((1, 1, 3), 0.6),
            finish=finish,
        )[0]

    return draw


@pytest.fixture(scope="module")
def ball() -> Mesh:
    shape = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    return Mesh(np.asarray(shape.vertices), np.asarray(shape.faces))


@pytest.fixture(scope="module")
def post_on_a_plate() -> Mesh:
    """The plate faces the camera, the post sticks out of it towards the camera."""
    plate = trimesh.creation.box(extents=(0.24, 0.24, 0.01))
    post = trimesh.creation.box(extents=(0.03, 0.03, 0.1))
    post.apply_translation([0, 0, -0.055])
    shape = trimesh.util.concatenate([plate, post])
    return Mesh(np.asarray(shape.vertices), np.asarray(shape.faces))


def test_no_finish_is_a_dull_and_smooth_one(ball):
    draw = drawer(ball, (0.4, -0.3, -0.6))
    assert torch.allclose(draw(), draw(finishes(1)), atol=1e-4)


def test_gloss_shows_where_the_light_is_mirrored_and_nowhere_else(ball):
    draw = drawer(ball, (0.5, 0.0, -0.5))
    more = (draw(finishes(1, gloss=0.8, sharpness=60.0)) - draw())[0]
    row, column = divmod(int(more.argmax()), SIZE)
    # Halfway between the light and the camera, 22.5 degrees off the axis: at sin 22.5 of the radius.
    assert row == pytest.approx(23.5, abs=1.5)
    assert column == pytest.approx(23.5 + 70 * 0.1 * np.sin(np.radians(22.5)) / (0.5 - 0.1 * np.cos(0.39)), abs=2)
    assert more.max() > 0.2
    assert more[:, :20].abs().max() < 0.01


def test_a_post_shades_the_plate_on_the_side_that_the_light_does_not_come_from(post_on_a_plate):
    draw = drawer(post_on_a_plate, (0.7, 0.0, -0.7))
    before, after = draw()[0], draw(finishes(1, shadow=1.0))[0]
    darker = before - after
    assert darker[20:28, 10:20].mean() > 0.1, "nothing is shaded behind the post"
    assert darker[20:28, 30:36].abs().max() < 0.01, "the lit side is shaded"
    half = before - draw(finishes(1, shadow=0.5))[0]
    assert 0 < half[20:28, 10:20].mean() < darker[20:28, 10:20].mean()


def test_a_second_light_shines_from_its_own_side_in_the_frame_of_the_camera(ball):
    draw = drawer(ball, (1e-6, 0.0, 0.0))
    lit = draw(finishes(1, fill=np.array([[-0.8, 0.0, -0.2]])))[0]
    assert lit[23, 14] > lit[23, 32] + 0.2
    assert torch.allclose(lit[23, 32], draw()[0, 23, 32], atol=1e-4)


def test_ambient_light_is_multiplied(ball):
    dark = drawer(ball, (0.0, 0.0, 1e-6), ambient=0.1)(finishes(1, ambient=2.0))
    assert torch.allclose(dark, drawer(ball, (0.0, 0.0, 1e-6), ambient=0.2)(), atol=1e-4)


@pytest.mark.parametrize("kind", ["grain", "bumps"])
def test_waves_change_what_is_even(ball, kind):
    draw = drawer(ball, (0.0, 0.0, -0.6))
    waves = np.zeros((1, NUM_WAVES, 4))
    waves[..., 0] = 12.0
    across = draw(finishes(1, waves=waves, **{kind: 0.3}))[0, 23, 16:31]
    even = draw()[0, 23, 16:31]
    turns = np.diff(np.sign(np.diff((across - even).numpy())))
    assert (turns != 0).sum() >= 2, "no waves across the ball"


def test_random_finishes_differ_and_are_finite(ball):
    drawn = random_appearances(64, np.random.default_rng(0))
    assert drawn.shape == (64, 1, APPEARANCE_SIZE)
    assert drawn.isfinite().all()
    assert torch.equal(drawn, random_appearances(64, np.random.default_rng(0)))
    draw = drawer(ball, (0.3, -0.4, -0.5))
    images = torch.stack([draw(one[None]) for one in drawn[:16]])
    assert images.isfinite().all()
    assert images.flatten(1).std(dim=0).max() > 0.1


def test_gradients_by_light_and_colour_equal_differences(meshes, draw, camera_matrix):
    """All but shadows, whose moving border has no gradient, as between objects."""
    codes = draw(16, 1, 5)
    size = codes.backgrounds.shape[-1]
    renderer = Renderer([meshes["root"]], [0], size, size, ambient=0.3, samples_per_pixel=16)
    finish = random_appearances(16, np.random.default_rng(1))
    finish[..., SHADOW] = 0
    target = torch.full_like(codes.backgrounds, 0.5)

    def loss(moved: Mapping[str, Tensor]) -> Tensor:
        images = renderer(
            codes.rotation,
            codes.translation_m,
            camera_matrix=camera_matrix,
            backgrounds=codes.backgrounds,
            light=codes.light + moved["light"],
            color=codes.color + moved["color"],
            finish=finish,
        )
        return (images - target).square().flatten(1).sum(1)

    zeros = {"light": torch.zeros_like(codes.light), "color": torch.zeros_like(codes.color)}
    ours, theirs = gradients(loss, zeros), central_differences(loss, zeros, list(zeros))
    for name in zeros:
        assert cosine(ours[name], theirs[name]) > 0.98, name
