"""Held-out poses follow the similarity into the world of the map."""

import numpy as np

from minislam.evaluation.trajectory import oriented_truth_to_estimate
from minislam.geometry.alignment import Similarity, umeyama
from minislam.records import Trajectory
from tests.helpers import random_transforms

# Identities


def test_views_follow_the_similarity_between_the_worlds():
    poses = random_transforms(20, "normal", 0).numpy()
    turn = random_transforms(1, "normal", 1)[0].numpy()
    s, R, t = 0.37, turn[:3, :3], turn[:3, 3]
    truth = Trajectory(np.arange(15.0), poses[:15])
    estimate = Trajectory(
        np.arange(15.0), Similarity(s, R, t).transform_poses(truth.T_world_camera)
    )
    novel = umeyama(truth.centres, estimate.centres).transform_poses(poses[15:])
    np.testing.assert_allclose(novel[:, :3, :3], R @ poses[15:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(novel[:, :3, 3], s * poses[15:, :3, 3] @ R.T + t, atol=1e-12)
    one = umeyama(truth.centres, estimate.centres).transform_poses(poses[15])
    np.testing.assert_array_equal(one, novel[0])


def test_a_point_seen_by_both_keeps_its_pixel():
    # A point of the benchmark's world and its image in the map's world lie on the same ray.
    pose = random_transforms(1, "normal", 2)[0].numpy()
    turn = random_transforms(1, "normal", 3)[0].numpy()
    similarity = Similarity(2.5, turn[:3, :3], turn[:3, 3])
    point = np.array([0.3, -0.2, 4.0])

    def ray(T_world_camera: np.ndarray, p_world: np.ndarray) -> np.ndarray:
        p_camera = (p_world - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
        return p_camera / np.linalg.norm(p_camera)

    moved = similarity.transform_poses(pose)
    np.testing.assert_allclose(
        ray(moved, similarity.transform_points(point)), ray(pose, point), atol=1e-12
    )


def test_orientations_find_the_turn_that_noisy_centres_on_a_line_leave_open():
    source = np.random.default_rng(0)
    poses = random_transforms(30, "normal", 4).numpy()
    poses[:, :3, 3] = np.linspace(0, 1, 30)[:, None] * [1.0, 0.0, 0.0]
    poses[:, 1:3, 3] += 0.01 * source.standard_normal((30, 2))  # hardly off the line
    turn = random_transforms(1, "normal", 5)[0].numpy()
    truth, world = Trajectory(np.arange(30.0), poses), Similarity(2.0, turn[:3, :3], turn[:3, 3])
    exact = world.transform_poses(poses)
    found = oriented_truth_to_estimate(Trajectory(np.arange(30.0), exact), truth)
    np.testing.assert_allclose(found.rotation, world.rotation, atol=1e-12)
    np.testing.assert_allclose(found.translation, world.translation, atol=1e-12)
    assert abs(found.scale - 2.0) < 1e-12

    noisy = exact.copy()
    noisy[:, :3, 3] += 0.01 * source.standard_normal((30, 3))
    estimate = Trajectory(np.arange(30.0), noisy)
    by_centres = umeyama(truth.centres, estimate.centres)
    by_cameras = oriented_truth_to_estimate(estimate, truth)
    assert np.abs(by_centres.rotation - world.rotation).max() > 0.02
    np.testing.assert_allclose(by_cameras.rotation, world.rotation, atol=1e-12)
