"""Routes and the hand-held camera path."""

from itertools import pairwise

import numpy as np
import pytest

from data_synth.motion import (
    CLIP_FRAMES,
    CLIP_SECONDS,
    FRAME_RATE,
    Route,
    clip_phase,
    handheld_path,
    path_length,
)

pytestmark = pytest.mark.slow


def some_path(seed):
    return handheld_path(np.random.default_rng(seed), np.array([0, -1.7, 1.4]), np.array([0, 1, 1]))


@pytest.mark.parametrize("seed", range(8))
def test_the_camera_walks_four_to_five_metres(seed):
    assert 4.0 < path_length(some_path(seed)) < 5.0


def test_poses_are_rigid_and_in_general_position():
    for time in np.linspace(0, 2 * CLIP_SECONDS, 17):
        T_world_camera = some_path(2)(time)
        R = T_world_camera[:3, :3]
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1.0)
        assert np.abs(T_world_camera - np.eye(4)).max() > 0.5


def test_the_path_is_smooth():
    path = some_path(4)
    poses = np.array([path(frame / FRAME_RATE) for frame in range(CLIP_FRAMES)])
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turns = [
        np.arccos(np.clip((np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2, -1, 1))
        for a, b in pairwise(poses)
    ]
    assert steps.max() < 0.12  # m
    assert max(turns) < np.radians(2.5)


def test_the_choreography_plays_forth_and_back():
    assert clip_phase(0.0) == 0.0
    assert clip_phase(CLIP_SECONDS) == pytest.approx(1.0)
    assert clip_phase(1.5 * CLIP_SECONDS) == pytest.approx(0.5)
    assert clip_phase(2.0 * CLIP_SECONDS) == pytest.approx(0.0)


def test_a_route_passes_through_its_waypoints_and_faces_where_it_goes():
    route = Route([(0, 0, 0), (0.5, 2, 0), (1, 4, 0)])
    np.testing.assert_allclose(route.position(0.5), [2, 0], atol=1e-12)
    assert route.walked(1.0) == pytest.approx(4.0, rel=1e-3)
    assert route.heading(0.5) == pytest.approx(0.0)
    assert route.pace(0.5) == 1.0


def test_a_resting_walker_faces_the_given_way():
    route = Route([(0, 1, 1), (0.5, 1, 1), (1, 3, 1)], facing=1.2)
    assert route.heading(0.2) == pytest.approx(1.2)
    assert route.pace(0.2) == pytest.approx(0.0, abs=1e-9)
