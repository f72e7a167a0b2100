"""Errors of an estimated trajectory against the truth: ATE and RPE, as evo computes them."""

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from scipy.spatial.transform import Rotation

from minislam.errors import InputError, require
from minislam.geometry.alignment import Similarity, umeyama
from minislam.records import Trajectory

MOST_SECONDS, MOST_RATIO = 1.0, 20.0  # of a step, and to the other's: beyond, no seconds


class Alignment(Enum):
    """What is fitted before the comparison. A monocular estimate needs a scale, so Sim(3)."""

    NONE = "no alignment"
    SCALE = "scale correction only"
    SE3 = "SE(3) Umeyama alignment"
    SIM3 = "Sim(3) Umeyama alignment"


@dataclass(frozen=True)
class TrajectoryError:
    """The comparison of an estimate with the truth."""

    statistics: dict[str, float]  # max, mean, median, min, rmse, sse, std
    errors: np.ndarray  # (N,) one per pair, units of the truth
    similarity: Similarity  # maps the estimate to the truth
    estimate: Trajectory  # (N) the paired poses, mapped
    truth: Trajectory  # (N) the paired poses


def absolute_trajectory_error(
    estimate: Trajectory,
    truth: Trajectory,
    alignment: Alignment = Alignment.SIM3,
    max_difference: float = 0.01,  # second between two poses of a pair, evo's default
) -> TrajectoryError:
    """Return the distances between estimated and true camera centres (ATE)."""
    least = 1 if alignment is Alignment.NONE else 3  # pairs
    estimate, truth = paired(estimate, truth, max_difference, least)
    similarity = Similarity(1.0, np.eye(3), np.zeros(3))
    if alignment is not Alignment.NONE:
        fitted = umeyama(estimate.centres, truth.centres, alignment is not Alignment.SE3)
        only_scale = alignment is Alignment.SCALE
        similarity = replace(similarity, scale=fitted.scale) if only_scale else fitted
    aligned = Trajectory(estimate.timestamps, similarity.transform_poses(estimate.T_world_camera))
    errors = np.linalg.norm(aligned.centres - truth.centres, axis=1)
    return TrajectoryError(statistics(errors), errors, similarity, aligned, truth)


def relative_pose_error(
    estimate: Trajectory, truth: Trajectory, step: int = 1, seconds: float | None = None
) -> tuple[np.ndarray, np.ndarray]:  # one per motion: world units, rad
    """Return the errors of the motions between paired poses `step` apart (RPE), without overlap.

    With Q = truth_i^-1 truth_(i+step), P likewise of the estimate and E = Q^-1 P, these are
    |translation of E| and the angle of E [rad]. Where the scale is unknown, align it first.
    Given `seconds`, the motions last so long instead; where poses are lost there may be none.
    """
    counts = f"{len(estimate)} estimated and {len(truth)} true ones; pair them with `paired`"
    require(len(estimate) == len(truth), "paired poses", counts)
    wanted = f"a step of 1 to {len(truth) - 1} of {len(truth)} paired poses"
    require(1 <= step < len(truth), wanted, f"{step}; choose a step between")
    first = np.arange(0, len(truth) - step, step)
    last = first + step
    if seconds is not None:
        first, last = _motions(truth.timestamps, seconds)
    true, found = truth.T_world_camera, estimate.T_world_camera
    true_motion = np.linalg.inv(true[first]) @ true[last]
    error = np.linalg.inv(true_motion) @ (np.linalg.inv(found[first]) @ found[last])
    angles = Rotation.from_matrix(error[:, :3, :3]).magnitude()
    return np.linalg.norm(error[:, :3, 3], axis=1), angles


def _motions(timestamps: np.ndarray, seconds: float) -> np.ndarray:  # (2, K) int, first and last
    """Return the poses that are about `seconds` apart, to half the time between most poses."""
    motions, end = [], 0
    tolerance = float(np.median(np.diff(timestamps))) / 2
    for first, last in zip(*associate(timestamps + seconds, timestamps, tolerance), strict=True):
        if end <= first < last:
            motions.append((first, last))
            end = last
    found = "none; give another --delta, or --delta_unit f"
    require(bool(motions), f"poses that are {seconds:g} s apart", found)
    return np.transpose(motions)


def straight_line_error(truth: Trajectory) -> float:
    """Return the ATE (rmse) of the straight line at constant speed that fits the truth best."""
    # It needs no images: an estimate that is not clearly better has not followed the camera.
    time = truth.timestamps - truth.timestamps.mean()
    design = np.stack([np.ones_like(time), time], axis=1)
    line, *_ = np.linalg.lstsq(design, truth.centres, rcond=None)
    return statistics(np.linalg.norm(truth.centres - design @ line, axis=1))["rmse"]


def paired(
    estimate: Trajectory, truth: Trajectory, max_difference: float, least: int = 1
) -> tuple[Trajectory, Trajectory]:
    """Return the poses of both trajectories that belong together, in order of time."""
    pairs = associate(estimate.timestamps, truth.timestamps, max_difference)
    if len(pairs[0]) < least:
        wanted = f"at least {least} timestamps of estimate and truth within {max_difference:g} s"
        found = f"{len(pairs[0])} (estimate {_span(estimate)}, truth {_span(truth)})"
        advice = "check that both belong together, or use --t_offset and --t_max_diff of eval"
        advice = doubt_of_units(estimate, truth) or advice
        raise InputError(f"expected {wanted} of each other, found {found}; {advice}")
    both = zip((estimate, truth), pairs, strict=True)
    matched = [Trajectory(path.timestamps[k], path.T_world_camera[k]) for path, k in both]
    return matched[0], matched[1]


def doubt_of_units(estimate: Trajectory, truth: Trajectory) -> str:
    """Return advice if the timestamps of one are probably not in seconds, else ""."""
    paths = estimate.timestamps, truth.timestamps
    found, true = (float(np.median(np.diff(t))) if len(t) > 1 else 0.0 for t in paths)
    counts = len(truth) > 1 and not (paths[1] % 1).any() and (paths[0] % 1).any()  # images
    if not counts and max(found, true) <= max(MOST_SECONDS, MOST_RATIO * min(found, true)):
        return ""
    return (
        f"check that the times of both are in seconds: poses of the estimate are {found:.3g} s "
        f"apart, those of the truth {true:.3g} s"
    )


def associate(
    first: np.ndarray,  # (N,) second, increasing
    second: np.ndarray,  # (M,) second, increasing
    max_difference: float,  # second
) -> tuple[np.ndarray, np.ndarray]:  # (K,) and (K,) int, positions in the first and the second
    """Pair each timestamp of the shorter list with the nearest of the longer, if near enough."""
    # Several of the shorter may share one, as in evo.
    if len(first) > len(second):
        of_second, of_first = associate(second, first, max_difference)
        return of_first, of_second
    after = np.searchsorted(second, first).clip(max=len(second) - 1)
    before = (after - 1).clip(min=0)
    earlier_is_nearer = np.abs(second[before] - first) <= np.abs(second[after] - first)
    nearest = np.where(earlier_is_nearer, before, after)
    kept = np.flatnonzero(np.abs(second[nearest] - first) <= max_difference)
    return kept, nearest[kept]


def oriented_truth_to_estimate(estimate: Trajectory, truth: Trajectory) -> Similarity:
    """Return the Sim(3) from truth to estimate, paired, with the mean rotation between cameras."""
    # If the camera moves nearly along a line, its centres hardly determine the rotation about that
    # line, and 3 mrad of it move a held-out view by a pixel. The rest comes from the centres.
    turned = estimate.T_world_camera[:, :3, :3] @ truth.T_world_camera[:, :3, :3].mT
    rotation = Rotation.from_matrix(turned).mean().as_matrix()
    source, target = truth.centres, estimate.centres
    source_mean, target_mean = source.mean(0), target.mean(0)
    source_turned = (source - source_mean) @ rotation.T
    scale = float((source_turned * (target - target_mean)).sum() / (source_turned**2).sum())
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def statistics(errors: np.ndarray) -> dict[str, float]:
    """Return the usual statistics of errors (N,), under the names that evo prints."""
    return {
        "max": float(errors.max()),
        "mean": float(errors.mean()),
        "median": float(np.median(errors)),
        "min": float(errors.min()),
        "rmse": float(np.sqrt((errors**2).mean())),
        "sse": float((errors**2).sum()),
        "std": float(errors.std()),
    }


def _span(trajectory: Trajectory) -> str:
    if len(trajectory) == 0:
        return "empty"
    ends = trajectory.timestamps[[0, -1]]
    poses = "1 pose" if len(trajectory) == 1 else f"{len(trajectory)} poses"
    return f"{poses}, {ends[0]:.3f} to {ends[1]:.3f} s"
