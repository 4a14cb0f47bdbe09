"""Rendered sequences: objects are where the truth says, and a board hides what it should."""

import numpy as np
import pytest
from curio_train.meshes.shapes import box
from synthetic_video import motions
from synthetic_video.sequences import Studio


@pytest.fixture(scope="module")
def studio() -> Studio:
    return Studio([box((0.1, 0.08, 0.12))] * 2, scale=0.25)


def test_objects_are_seen_where_the_truth_puts_them(studio: Studio) -> None:
    random = np.random.default_rng(0)
    paths = motions.side_by_side(4, random)
    video = studio.film(paths, random)
    assert video.frames.shape == (4, 120, 160, 3)
    for frame, poses in zip(video.frames, video.cam_from_obj, strict=True):
        for pose in poses:
            x, y, z = video.matrix @ pose[:3, 3]
            column, row = round(x / z), round(y / z)
            patch = frame[row - 1 : row + 2, column - 1 : column + 2].astype(float)
            assert patch.std(axis=(0, 1)).max() < 25  # one face of the box, not clutter
    assert video.frames[0].std() > 10


def test_a_board_hides_the_whole_view_and_noise_is_new_in_each_frame(studio: Studio) -> None:
    random = np.random.default_rng(1)
    video = studio.film([motions.at_rest(6, random), motions.carried_past(6, random)], random, slice(2, 4))
    assert video.hidden.tolist() == [False, False, True, True, False, False]
    spread = video.frames.astype(float).std(axis=(1, 2, 3))
    assert spread[2:4].max() < spread[[0, 1, 4, 5]].min() / 2
    changes = np.abs(video.frames[2].astype(int) - video.frames[3])
    assert 0 < changes.mean() < 6


@pytest.mark.parametrize("motion", [motions.at_rest, motions.carried_past, motions.wandering])
def test_motions_are_rigid_drawn_by_their_seed_and_before_the_camera(motion) -> None:
    first, again = (motion(31, np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    rotations = first[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (31, 1, 1)), atol=1e-9)
    assert np.all(np.linalg.det(rotations) > 0.999)
    assert first[:, 2, 3].min() > 0.4


def test_speeds_and_distances_are_as_said() -> None:
    random = np.random.default_rng(2)
    steps = np.diff(motions.carried_past(20, random)[:, :3, 3], axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1) * motions.FRAMES_PER_SECOND, 0.5)
    left, right = motions.side_by_side(60, random)
    apart = np.linalg.norm(left[:, :3, 3] - right[:, :3, 3], axis=1)
    assert 0.165 < apart.min() < 0.2 < apart.max()
