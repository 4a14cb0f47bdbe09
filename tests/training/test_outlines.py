"""Outlines of templates, and the distances at which they lie on edges of pictures."""

import numpy as np
import pytest
import torch
import trimesh
from curio_train.meshes.meshes import Mesh
from curio_train.networks.templates.alignment import Aligned
from curio_train.networks.templates.bank import NUM_OUTLINE_POINTS
from curio_train.networks.templates.geometry import CROP_PX, FILL, Geometry, num_views, viewpoints
from curio_train.networks.templates.outline import outline_log_factor
from curio_train.templates.outline import outlines
from torch import Tensor

FOCAL_PX, DISTANCE = 450.0, 5.0  # crop pixels, diameters


def disc(distance: float, centre: tuple[float, float], inside: float, outside: float) -> Tensor:
    """A crop of a flat disc of diameter 1 across the line of sight, with a soft edge of a pixel."""
    steps = torch.arange(CROP_PX) - (CROP_PX - 1) / 2
    y, x = torch.meshgrid(steps, steps, indexing="ij")
    radius = torch.hypot(x - FOCAL_PX * centre[0] / distance, y - FOCAL_PX * centre[1] / distance)
    coverage = (FOCAL_PX * 0.5 / distance - radius + 0.5).clamp(0, 1)
    return (coverage * inside + (1 - coverage) * outside).expand(1, 3, -1, -1)


def factor(picture: Tensor, distance: float, centre: tuple[float, float]) -> float:
    angle = torch.arange(64) * (2 * torch.pi / 64)
    outward = torch.stack([angle.cos(), angle.sin(), torch.zeros(64)], dim=1)[None]
    pose = Aligned(torch.eye(3)[None], torch.tensor([[*centre, distance]]), torch.ones(1))
    return float(outline_log_factor(picture, outward / 2, outward, pose, torch.tensor([FOCAL_PX]), picture.shape[-1]))


@pytest.mark.parametrize("error", [-0.04, -0.01, 0.0, 0.02, 0.05])
@pytest.mark.parametrize(("inside", "outside"), [(0.9, 0.2), (0.3, 0.6)])
def test_an_outline_tells_the_distance_at_which_it_lies_on_the_edge(
    error: float, inside: float, outside: float
) -> None:
    centre = (0.1, -0.05)
    too_far = float(np.exp(error))
    seen = disc(DISTANCE, centre, inside, outside)
    assert factor(seen, DISTANCE * too_far, (0.1 * too_far, -0.05 * too_far)) == pytest.approx(-error, abs=0.004)


def test_where_there_is_no_edge_the_distance_stays() -> None:
    assert factor(disc(DISTANCE, (0.0, 0.0), 0.5, 0.5), DISTANCE, (0.0, 0.0)) == pytest.approx(0, abs=1e-6)


def test_outlines_of_a_ball_are_great_circles_across_the_line_of_sight() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    mesh = Mesh(np.asarray(ball.vertices), np.asarray(ball.faces))
    matrix = np.array([[572.4, 0, 325.3], [0, 573.6, 242.0], [0, 0, 1]])
    geometry = Geometry(matrix, 640, 480, 0.1, 0.5, 1.5)
    found = outlines(mesh, geometry)
    assert found.points.shape == found.outward.shape == (num_views(False), NUM_OUTLINE_POINTS, 3)
    line_of_sight = viewpoints(num_views(False), 1)[:, None, 2]
    assert (found.outward * line_of_sight).sum(dim=2).abs().max() < 1e-5
    across = found.points - (found.points * line_of_sight).sum(dim=2, keepdim=True) * line_of_sight
    pixel = 1 / (FILL * CROP_PX)  # in diameters
    assert across.norm(dim=2).median() == pytest.approx(0.5, abs=pixel)
    assert (torch.nn.functional.normalize(across, dim=2) * found.outward).sum(dim=2).quantile(0.05) > 0.95
