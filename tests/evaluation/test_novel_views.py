"""Held-out poses are carried into the world of the map."""

import numpy as np
from helpers import random_transforms

from minislam.evaluation.novel_views import align_novel_views, truth_to_estimate
from minislam.geometry.alignment import Similarity
from minislam.records import Trajectory

# Identities


def test_views_follow_the_similarity_between_the_worlds():
    poses = random_transforms(20, "normal", 0).numpy()
    turn = random_transforms(1, "normal", 1)[0].numpy()
    s, R, t = 0.37, turn[:3, :3], turn[:3, 3]
    truth = Trajectory(np.arange(15.0), poses[:15])
    estimate = Trajectory(
        np.arange(15.0), Similarity(s, R, t).transform_poses(truth.T_world_camera)
    )
    novel = align_novel_views(poses[15:], truth_to_estimate(estimate, truth))
    np.testing.assert_allclose(novel[:, :3, :3], R @ poses[15:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(novel[:, :3, 3], s * poses[15:, :3, 3] @ R.T + t, atol=1e-12)
    one = align_novel_views(poses[15], truth_to_estimate(estimate, truth))
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

    moved = align_novel_views(pose, similarity)
    np.testing.assert_allclose(
        ray(moved, similarity.transform_points(point)), ray(pose, point), atol=1e-12
    )
