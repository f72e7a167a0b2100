"""ATE and RPE: numbers by hand, invariances, equality with evo."""

import copy
import importlib

import numpy as np
import pytest

from minislam.errors import InputError
from minislam.evaluation.trajectory import (
    Alignment,
    absolute_trajectory_error,
    associate,
    doubt_of_units,
    relative_pose_error,
    statistics,
    straight_line_error,
)
from minislam.geometry.alignment import Similarity
from minislam.records import Trajectory
from tests.helpers import random_transforms


def spiral(count: int, seed: int = 0) -> Trajectory:
    """Return a path in general position with random orientations, ten poses a second."""
    time = np.arange(count) / 10
    poses = random_transforms(count, "normal", seed).numpy()
    poses[:, :3, 3] = np.stack([np.cos(time), np.sin(time), 0.3 * time], axis=1)
    return Trajectory(100 + time, poses)


def disturbed(trajectory: Trajectory, sigma: float, seed: int) -> Trajectory:
    poses = trajectory.T_world_camera.copy()
    poses[:, :3, 3] += sigma * np.random.default_rng(seed).normal(size=(len(poses), 3))
    return Trajectory(trajectory.timestamps, poses)


def moved(trajectory: Trajectory, scale: float, seed: int) -> Trajectory:
    T = random_transforms(1, "normal", seed)[0].numpy()
    similarity = Similarity(scale, T[:3, :3], T[:3, 3])
    poses = similarity.transform_poses(trajectory.T_world_camera)
    return Trajectory(trajectory.timestamps, poses)


# Known answers


def test_one_pose_off_by_three_of_four():
    # Errors 0, 0, 0, 3: mean 0.75, rmse sqrt(9 / 4), sse 9, std sqrt(9 / 4 - 0.75^2).
    truth = spiral(4)
    poses = truth.T_world_camera.copy()
    poses[3, :3, 3] += [0, 0, 3]
    estimate = Trajectory(truth.timestamps, poses)
    found = absolute_trajectory_error(estimate, truth, Alignment.NONE).statistics
    expected = {
        "max": 3, "mean": 0.75, "median": 0, "min": 0, "rmse": 1.5, "sse": 9,
        "std": np.sqrt(2.25 - 0.5625),
    }  # fmt: skip
    assert found == pytest.approx(expected, abs=1e-12)


def test_stored_answer_of_evo():
    # evo 1.38.1 on the same two trajectories: APE of the translation part, with -as and with -a;
    # RPE with a step of one frame. Kept as numbers, since evo may not be installed.
    truth = spiral(40)
    estimate = moved(disturbed(truth, 0.05, seed=1), scale=0.4, seed=2)
    similar = absolute_trajectory_error(estimate, truth, Alignment.SIM3)
    rigid = absolute_trajectory_error(estimate, truth, Alignment.SE3)
    distance, _ = relative_pose_error(similar.estimate, truth)
    found = [similar.statistics["rmse"], rigid.statistics["rmse"], statistics(distance)["rmse"]]
    evo = [0.07186815551371462, 0.5790098984390287, 0.10324781178570246]
    np.testing.assert_allclose(found, evo, atol=1e-9)


def test_the_nearest_timestamps_are_paired():
    first, second = np.array([0.0, 1.0, 2.0, 9.0]), np.array([0.02, 0.9, 1.05, 2.3, 5.0])
    pairs = associate(first, second, 0.1)
    np.testing.assert_array_equal(pairs, [[0, 1], [0, 2]])
    # The shorter list leads, whichever comes first.
    np.testing.assert_array_equal(associate(second, first, 0.1), [[0, 2], [0, 1]])
    assert len(associate(np.array([1.0]), np.array([1.15]), 0.1)[0]) == 0


def test_a_tie_goes_to_the_earlier_one():
    np.testing.assert_array_equal(associate(np.array([1.0]), np.array([0.5, 1.5]), 1), [[0], [0]])


def test_rpe_of_a_known_step():
    # The estimate turns by 0.1 rad about z and moves by 1.5 where the truth stays straight.
    truth = Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    truth.T_world_camera[:, 0, 3] = [0, 1, 2]
    estimate = Trajectory(truth.timestamps, truth.T_world_camera.copy())
    c, s = np.cos(0.1), np.sin(0.1)
    estimate.T_world_camera[1:, :2, :2] = [[c, -s], [s, c]]
    estimate.T_world_camera[1:, :2, 3] = np.array([[1.5, 0], [1.5 + c, s]])
    distances, angles = relative_pose_error(estimate, truth)
    np.testing.assert_allclose(distances, [0.5, 0], atol=1e-12)
    np.testing.assert_allclose(angles, [0.1, 0], atol=1e-12)


def test_motions_last_as_asked_where_poses_are_lost_and_not_evenly_spaced():
    # At 0.2 m/s too fast, the error of every second is 0.2 m. Of 4.1 to 7.9 s there are no poses.
    every, seldom = np.arange(120) / 10, np.cumsum(np.tile([0.1, 0.1, 0.4], 20))
    for times, count in ((every[(every <= 4) | (every >= 8)], 4 + 3), (seldom, 10)):
        truth, estimate = (Trajectory(times, np.tile(np.eye(4), (len(times), 1, 1))) for _ in "12")
        truth.T_world_camera[:, 0, 3], estimate.T_world_camera[:, 0, 3] = times, 1.2 * times
        distances, _ = relative_pose_error(estimate, truth, seconds=1.0)
        np.testing.assert_allclose(distances, count * [0.2], atol=1e-9)
    with pytest.raises(InputError, match=r"expected poses that are 30 s apart, found none; give"):
        relative_pose_error(estimate, truth, seconds=30.0)


def test_a_straight_walk_is_explained_by_the_line_and_a_circle_is_not():
    straight = spiral(50)
    straight.T_world_camera[:, :3, 3] = np.outer(straight.timestamps, [1, 2, 3]) + 5
    assert straight_line_error(straight) < 1e-10
    time = np.linspace(0, 2 * np.pi, 100_001)[:-1]
    circle = Trajectory(time, np.tile(np.eye(4), (len(time), 1, 1)))
    circle.T_world_camera[:, :2, 3] = np.stack([np.cos(time), np.sin(time)], axis=1)
    # The line through a full circle explains of x nothing and of sin t the share 6 / pi^2.
    assert straight_line_error(circle) == pytest.approx(np.sqrt(1 - 3 / np.pi**2), abs=1e-4)


# Identities


@pytest.mark.parametrize("seed", range(3))
def test_what_is_fitted_is_forgiven(seed: int):
    truth = spiral(30, seed)
    similar, rigid = moved(truth, 3.0, seed), moved(truth, 1.0, seed)
    assert absolute_trajectory_error(similar, truth).statistics["max"] < 1e-12
    assert absolute_trajectory_error(rigid, truth, Alignment.SE3).statistics["max"] < 1e-12
    scaled = Trajectory(truth.timestamps, truth.T_world_camera.copy())
    scaled.T_world_camera[:, :3, 3] *= 2.5
    # Scaling alone is found only where the rotation fitted beside it is none.
    assert absolute_trajectory_error(scaled, truth, Alignment.SCALE).statistics["max"] < 1e-12
    assert absolute_trajectory_error(similar, truth, Alignment.SE3).statistics["rmse"] > 0.1
    assert absolute_trajectory_error(rigid, truth, Alignment.NONE).statistics["rmse"] > 0.1


def test_orientations_are_aligned_with_the_path():
    truth = spiral(30)
    found = absolute_trajectory_error(moved(truth, 0.2, 5), truth)
    np.testing.assert_allclose(found.estimate.T_world_camera, truth.T_world_camera, atol=1e-12)


def evo_statistics(estimate: Trajectory, truth: Trajectory, alignment: Alignment) -> dict:
    """Return what evo_ape and evo_rpe compute."""
    metrics = importlib.import_module("evo.core.metrics")
    sync = importlib.import_module("evo.core.sync")
    path_type = importlib.import_module("evo.core.trajectory").PoseTrajectory3D
    paths = [
        path_type(poses_se3=list(one.T_world_camera), timestamps=one.timestamps)
        for one in (truth, estimate)
    ]
    reference, path = sync.associate_trajectories(*paths, max_diff=0.01)
    path = copy.deepcopy(path)
    if alignment is not Alignment.NONE:
        path.align(
            reference,
            correct_scale=alignment is Alignment.SIM3,
            correct_only_scale=alignment is Alignment.SCALE,
        )
    found = {}
    part = metrics.PoseRelation
    for name, metric in {
        "ape": metrics.APE(part.translation_part),
        "rpe": metrics.RPE(part.translation_part, 3, metrics.Unit.frames),
        "angle": metrics.RPE(part.rotation_angle_rad, 3, metrics.Unit.frames),
    }.items():
        metric.process_data((reference, path))
        found[name] = metric.get_all_statistics()
    return found


@pytest.mark.parametrize("alignment", list(Alignment))
def test_equality_with_evo(alignment: Alignment):
    pytest.importorskip("evo")
    truth = spiral(80)
    estimate = moved(disturbed(truth, 0.05, 1), 0.4, 2)
    # Some poses are missing and the clocks differ by some milliseconds.
    kept = np.sort(np.random.default_rng(3).permutation(80)[:60])
    jitter = np.random.default_rng(4).uniform(-0.015, 0.015, 60)
    estimate = Trajectory(estimate.timestamps[kept] + jitter, estimate.T_world_camera[kept])
    found = absolute_trajectory_error(estimate, truth, alignment)
    distances, angles = relative_pose_error(found.estimate, found.truth, step=3)
    expected = evo_statistics(estimate, truth, alignment)
    assert found.statistics == pytest.approx(expected["ape"], rel=1e-9, abs=1e-9)
    assert statistics(distances) == pytest.approx(expected["rpe"], rel=1e-9, abs=1e-9)
    assert statistics(angles) == pytest.approx(expected["angle"], rel=1e-9, abs=1e-9)


# Errors


def test_clocks_that_never_meet_are_refused():
    truth = spiral(10)
    late = Trajectory(truth.timestamps + 1000, truth.T_world_camera)
    with pytest.raises(InputError, match=r"1100\.000 to 1100\.900 s.*--t_offset"):
        absolute_trajectory_error(late, truth)
    empty = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    with pytest.raises(InputError, match="estimate empty"):
        absolute_trajectory_error(empty, truth)


def test_a_single_pair_cannot_be_aligned():
    words = (
        r"at least 3 timestamps .* found 1 \(estimate 1 pose, 100\.000 to 100\.000 s, truth 10 p"
    )
    with pytest.raises(InputError, match=words):
        absolute_trajectory_error(spiral(1), spiral(10))
    assert absolute_trajectory_error(spiral(1), spiral(10), Alignment.NONE).statistics["max"] == 0


def test_times_in_milliseconds_are_told_from_a_truth_of_few_poses():
    truth = spiral(10)
    for unit in (1e3, 1e9):
        other = Trajectory(truth.timestamps * unit, truth.T_world_camera)
        words = r"found 0 .*; check that the times of both are in seconds: poses of the"
        with pytest.raises(InputError, match=words):
            absolute_trajectory_error(truth, other)
        assert doubt_of_units(truth, other) and doubt_of_units(other, truth)
        assert not doubt_of_units(other, other)
    for step in (1, 2, 5):  # the truth counts images, of which every second or fifth was taken
        estimate = Trajectory(np.arange(10) * step / 30, truth.T_world_camera)
        assert doubt_of_units(estimate, Trajectory(np.arange(10.0), truth.T_world_camera))
    rare = Trajectory(truth.timestamps[[0, 9]], truth.T_world_camera[[0, 9]])
    assert not doubt_of_units(truth, rare) and not doubt_of_units(truth, spiral(1))


def test_unpaired_paths_have_no_relative_error():
    with pytest.raises(InputError, match="paired poses, found 9 estimated and 10 true ones; pair"):
        relative_pose_error(spiral(9), spiral(10))


@pytest.mark.parametrize("step", [0, 10])
def test_impossible_steps_are_refused(step: int):
    with pytest.raises(InputError, match="a step of 1 to 9 of 10 paired poses"):
        relative_pose_error(spiral(10), spiral(10), step)
