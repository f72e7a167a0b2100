"""Umeyama's alignment against constructed similarities, and where it has no answer."""

import numpy as np
import pytest

from minislam.errors import InputError
from minislam.geometry.alignment import Similarity, umeyama
from tests.helpers import random_transforms


def random_points(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3))


def random_similarity(seed: int, scale: float) -> Similarity:
    T = random_transforms(1, "normal", seed)[0].numpy()
    return Similarity(scale, T[:3, :3], 10 * T[:3, 3])


# Known answers


def test_a_quarter_turn_with_scale_two_is_found():
    # (x, y, z) -> 2 (-y, x, z) + (1, 2, 3), by hand.
    source = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    target = np.array([[1.0, 4, 3], [-1, 2, 3], [1, 2, 5], [-1, 4, 5]])
    found = umeyama(source, target)
    assert abs(found.scale - 2) < 1e-12
    np.testing.assert_allclose(found.rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(found.translation, [1, 2, 3], atol=1e-12)


def test_mirrored_points_give_a_rotation_not_a_reflection():
    # The best orthogonal map would be the mirror x -> -x; among rotations the best is to give up
    # the axis of least extent: the half turn about y, which turns z as well.
    source = np.array([[2.0, 0, 0], [-2, 0, 0], [0, 3, 0], [0, -3, 0], [0, 0, 1], [0, 0, -1]])
    found = umeyama(source, source * [-1, 1, 1])
    np.testing.assert_allclose(found.rotation, np.diag([-1.0, 1, -1]), atol=1e-12)
    # c = (d1 + d2 - d3) / variance with d = (8, 18, 2) / 6 and variance 28 / 6: 24 / 28.
    assert abs(found.scale - 24 / 28) < 1e-12


# Identities


@pytest.mark.parametrize("scale", [1e-3, 1.0, 37.0])
@pytest.mark.parametrize("seed", range(5))
def test_an_applied_similarity_is_found_again(scale: float, seed: int):
    truth, source = random_similarity(seed, scale), random_points(20, seed)
    found = umeyama(source, truth.transform_points(source))
    assert abs(found.scale / scale - 1) < 1e-12
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-12)
    np.testing.assert_allclose(found.translation, truth.translation, atol=1e-11)


def test_without_scale_the_map_is_rigid():
    source = random_points(20, 0)
    found = umeyama(source, random_similarity(0, 5.0).transform_points(source), with_scale=False)
    assert found.scale == 1.0
    np.testing.assert_allclose(found.rotation, random_similarity(0, 5.0).rotation, atol=1e-12)


def test_no_small_change_of_the_answer_is_better():
    source, target = random_points(30, 1), random_points(30, 2)
    found = umeyama(source, target)

    def cost(similarity: Similarity) -> float:
        return float(((target - similarity.transform_points(source)) ** 2).sum())

    for turn in random_transforms(20, "normal", 3).numpy():
        axis_angle = 1e-3 * (turn[:3, :3] - turn[:3, :3].T)
        u, _, vt = np.linalg.svd(np.eye(3) + axis_angle)
        other = Similarity(found.scale, u @ vt @ found.rotation, found.translation)
        assert cost(other) >= cost(found)
    assert cost(Similarity(found.scale * 1.001, found.rotation, found.translation)) > cost(found)
    assert cost(Similarity(found.scale * 0.999, found.rotation, found.translation)) > cost(found)


def test_points_in_a_plane_have_one_answer():
    source = random_points(10, 4) * [1, 1, 0]
    truth = random_similarity(4, 2.0)
    found = umeyama(source, truth.transform_points(source))
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-12)


def test_poses_move_with_their_centres():
    similarity = random_similarity(7, 3.0)
    poses = random_transforms(5, "normal", 8).numpy()
    moved = similarity.transform_poses(poses)
    centres = similarity.transform_points(poses[:, :3, 3])
    np.testing.assert_allclose(moved[:, :3, 3], centres, atol=1e-12)
    # A point one unit ahead of the camera is `scale` units ahead afterwards.
    ahead = similarity.transform_points(poses[:, :3, 3] + poses[:, :3, 2])
    np.testing.assert_allclose(ahead - centres, 3.0 * moved[:, :3, 2], atol=1e-11)
    np.testing.assert_array_equal(
        Similarity(1.0, np.eye(3), np.zeros(3)).transform_poses(poses), poses
    )


# Degenerate input and errors


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_points_are_refused(count: int):
    with pytest.raises(InputError, match="at least 3 pairs"):
        umeyama(random_points(count, 0), random_points(count, 1))


def test_points_that_are_not_finite_are_counted():
    points = random_points(4, 0)
    points[1, 2] = np.nan
    with pytest.raises(InputError, match="found 4, of which 3 are finite"):
        umeyama(points, random_points(4, 1))


def test_points_on_a_line_are_refused():
    line = np.arange(10)[:, None] * np.array([[1.0, 2.0, -0.5]]) + 3
    with pytest.raises(InputError, match="on one line"):
        umeyama(line, random_similarity(0, 2.0).transform_points(line))


def test_a_camera_that_stands_still_is_refused():
    with pytest.raises(InputError, match="does not move"):
        umeyama(np.ones((5, 3)), random_points(5, 0))


def test_nan_is_refused():
    source = random_points(5, 0)
    source[2, 1] = np.nan
    with pytest.raises(InputError, match="finite"):
        umeyama(source, random_points(5, 1))


@pytest.mark.parametrize("unit", [1e-4, 1e4])
def test_what_is_on_one_line_does_not_depend_on_the_unit(unit: float):
    points, truth = unit * random_points(10, 0), random_similarity(0, 2.0)
    assert umeyama(points, truth.transform_points(points)).scale == pytest.approx(2.0)
    line = unit * np.arange(10)[:, None] * np.array([[1.0, 2.0, -0.5]])
    with pytest.raises(InputError, match="on one line"):
        umeyama(line, truth.transform_points(line))
