"""Dense depth of keyframes, against the truth of the ray-caster, and which frames are swept."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from minislam.geometry import Camera
from minislam.records import MapImage
from minislam.stereo import dense_structure
from minislam.stereo.dense_structure import (
    FARTHEST,
    SweepPlanner,
    dense_depths,
    full_size,
    on_backdrop,
    swept_frames,
    swept_view,
    with_swept_depth,
)
from minislam.stereo.sweep import PosedImage
from minislam.stereo.votes import ConfirmedDepth, confirm
from minislam.workers import Workers
from tests.stereo.clip import KEYFRAMES, SIZE, camera, clip, found, pose, sequence
from tests.tracking.wall import true_graph

pytestmark = pytest.mark.slow


def planner(poses: dict[int, torch.Tensor], *known: int) -> SweepPlanner:
    """Return the planner of the clip, with a wall one unit away in the known frames."""
    return SweepPlanner(sequence().frame, camera(), poses, {k: np.ones(3) for k in known})


# Against the truth (measured: known .79 to .93 and .07 to .11, error .7 to 1 %, 95 % below 5.4 %)


@pytest.mark.parametrize("index", range(len(KEYFRAMES)))
def test_static_pixels_are_known_and_exact_and_dynamic_ones_unknown(index: int):
    seen = found()[index]
    known, static = seen.depth > 0, ~seen.moving
    assert known[static].mean() > 0.7 and known[seen.moving].mean() < 0.2
    error = np.abs(seen.depth / seen.truth - 1)[known]
    assert np.median(error) < 0.015 and np.quantile(error, 0.95) < 0.08


@pytest.mark.parametrize("index", range(len(KEYFRAMES)))
def test_what_stands_still_is_confirmed(index: int):
    seen = found()[index]
    assert seen.confirmation[~seen.moving].mean() > 0.7
    assert seen.confirmation[seen.moving].mean() < 0.2
    assert seen.confirmation.max() <= 1 + 1e-6
    assert (seen.confirmation[~seen.moving] < 0).mean() < 0.01


def test_what_lies_at_infinity_is_known_to_be_far():
    noise = np.random.default_rng(0).uniform(0, 1, (30, 40)).astype(np.float32)
    gray = cv2.blur(noise, (3, 3))  # all views show the same, however far apart they are
    poses = [np.eye(4) for _ in range(5)]
    for index, posed in enumerate(poses):
        posed[0, 3] = 0.1 * index
    images, planes = [PosedImage(gray, posed) for posed in poses], np.linspace(0, 2, 48)
    far = Camera(40.0, 40.0, 20.0, 15.0, 40, 30)
    views = [
        swept_view(far, image, [i for i in images if i is not image], planes) for image in images
    ]
    depth = confirm(far, views[2], views[:2] + views[3:]).inverse_depth
    infinity = np.float32(FARTHEST * planes[1])
    assert (depth > 0).mean() > 0.9 and np.median(depth) == infinity
    blank = [PosedImage(np.full_like(gray, 0.5), posed) for posed in poses]  # as far as near
    alike = swept_view(far, blank[2], blank[:2] + blank[3:], planes).inverse_depth
    assert not (alike == infinity).any() and np.isnan(alike).mean() > 0.5


def test_a_line_along_the_motion_is_left_out():
    noise = np.random.default_rng(0).uniform(0, 1, (30, 60)).astype(np.float32)
    gray = cv2.blur(noise, (3, 3))
    gray[10:20] = 0.5 + 0.3 * np.sin(np.arange(10.0))[:, None]  # the same at every depth
    images = []
    for index in range(5):
        posed = np.eye(4)
        posed[0, 3] = -0.4 * index
        images.append(PosedImage(np.roll(gray, -4 * index, 1), posed))
    far, planes = Camera(40.0, 40.0, 30.0, 15.0, 60, 30), np.linspace(0, 1, 48)
    every, told = (
        swept_view(far, images[2], images[:2] + images[3:], planes, drops_lines=drops)
        for drops in (False, True)
    )
    textured, line = np.r_[0:7, 23:30], np.s_[13:17]
    inner = np.s_[15:45]
    assert np.isfinite(every.inverse_depth[line, inner]).all()
    assert np.isnan(told.inverse_depth[line, inner]).all()
    np.testing.assert_array_equal(told.inverse_depth[textured], every.inverse_depth[textured])
    assert np.median(told.inverse_depth[textured][:, inner]) == pytest.approx(0.25, abs=0.02)


def test_coarse_sweeps_and_those_of_little_parallax_keep_lines():
    poses = {}
    for index in range(9):
        poses[index] = torch.eye(4, dtype=torch.float64)
        poses[index][0, 3] = 0.01 * index
    for width, nearest, leaves in ((160, 8.0, True), (80, 8.0, False), (160, 1.0, False)):
        inputs = camera(), poses, {0: np.full(9, nearest)}, width
        assert SweepPlanner(sequence().frame, *inputs).plan(0)[-1] is leaves


# Which frames


def test_every_third_frame_of_a_gap_at_most_is_swept():
    assert swept_frames([0, 1, 4, 20], list(range(24))) == [0, 1, 4, 10, 15, 20]
    assert swept_frames([0, 4], list(range(5))) == [0, 2, 4]
    assert swept_frames([0, 4], [0, 4]) == [0, 4] == swept_frames([0, 4], [0, 4], least=1)
    assert swept_frames([0, 1, 3, 20], list(range(24)), least=1) == [0, 1, 2, 3, 9, 14, 20]


def test_of_a_long_gap_every_eighth_frame_is_swept():
    assert swept_frames([0, 40], list(range(41))) == [0, 8, 16, 24, 32, 40]
    assert swept_frames([0, 23], list(range(24))) == [0, 8, 15, 23]


def test_views_of_much_parallax_are_not_used():
    poses = {}
    for index in range(20):
        poses[index] = torch.eye(4, dtype=torch.float64)
        poses[index][0, 3] = 0.1 * index
    plan = planner(poses)
    near = plan._views(0, 0.3)
    largest = max(near) * 0.1 * 0.3 * plan.camera.fx
    assert len(near) >= 2 and largest <= 0.125 * plan.camera.width
    assert list(plan._views(0, 1e-3)) == [1, 4, 6, 9, 11, 14, 16, 19]  # spread evenly
    assert list(plan._views(0, 1e3)) == [1, 2]  # the two nearest, if all are too far


# Degenerate input


def test_a_camera_that_stands_still_gives_no_depth():
    poses = {index: torch.from_numpy(pose(0)) for index in range(6)}
    depths = dense_depths(planner(poses, 0, 5), [0, 5], [0, 5])
    assert all(float(depth.max()) == 0 == float(c.max()) for depth, c in depths)


def test_a_single_frame_gives_no_depth():
    alone = planner({0: torch.from_numpy(pose(0))}, 0)
    ((depth, confirmation),) = dense_depths(alone, [0], [0])
    assert depth.shape == SIZE[::-1] and float(depth.max()) == 0 == float(confirmation.max())


def test_a_graph_tells_the_sweep_its_camera_poses_and_disparities():
    graph, posed = true_graph([0, 3, 6, 9]), [3, 6, 9]  # a piece of a broken path
    poses = dict.fromkeys(posed, torch.eye(4))
    plan = SweepPlanner.of(graph, SimpleNamespace(), poses, width=40)
    assert plan.of_images == graph.grid.camera and plan.camera.width == 40
    assert list(plan._poses) == list(plan._known) == posed
    nearest = [float(np.max(disparities)) for disparities in plan._known.values()]
    assert nearest == pytest.approx(graph.keyframes.disparities.amax(1)[1:].tolist(), rel=0.2)


def test_depths_are_enlarged_one_by_one(monkeypatch):
    enlarged = []
    nothing = torch.zeros(SIZE[::-1]), torch.zeros(SIZE[::-1])
    monkeypatch.setattr(dense_structure, "full_size", lambda *v: enlarged.append(v) or nothing)
    poses = {index: torch.from_numpy(pose(index)) for index in range(3)}
    depths = dense_depths(planner(poses, 0, 2), [0, 2], [0, 2])
    assert not enlarged  # hundreds of them would fill the memory
    next(depths)
    assert len(enlarged) == 1


def test_progress_counts_the_swept_frames():
    told = []
    poses = {index: torch.from_numpy(pose(index)) for index in range(3)}
    for frames in ([0, 2], [0, 1, 2]):
        found = dense_depths(planner(poses, 0, 2), frames, [2], lambda *step: told.append(step))
        assert len(list(found)) == 1  # of the frame that is wanted
    assert told == [(1, 2), (2, 2), (1, 3), (2, 3), (3, 3)]


def test_a_helper_sweeps_to_the_same_bits():
    poses = {index: torch.from_numpy(pose(index)) for index in range(3)}
    calls = planner(poses, 0, 2), [0, 2], [0, 2]
    with Workers(2) as two:
        alone, shared = dense_depths(*calls), dense_depths(*calls, workers=two)
    for (depth, confirmation), other in zip(alone, shared, strict=True):
        assert torch.equal(depth, other[0]) and torch.equal(confirmation, other[1])


# The size of the images


def test_a_slope_is_interpolated_and_an_edge_is_not():
    slope = np.tile(np.linspace(1, 1.2, 16, dtype=np.float32), (12, 1))
    slope[:, 8:] *= 2  # an edge
    slope[0, 0] = 0  # unknown
    big = Camera(30.0, 30.0, 15.5, 11.5, 32, 24)
    depth, confirmation = full_size(ConfirmedDepth(slope, np.ones_like(slope)), big)
    assert depth.shape == confirmation.shape == (24, 32)
    assert float(depth[0, 0]) == 0 and float(depth[4:, :16].min()) > 0
    inverse = 1 / depth[12]
    assert float((inverse[1:15] - inverse[:14]).min()) > 0  # a slope, no steps
    allowed = (inverse[:16].max() <= slope[5, 7] + 1e-5, inverse[16:].min() >= slope[5, 8] - 1e-5)
    assert all(allowed)  # nothing between the two surfaces


def test_an_edge_stays_in_its_place_at_any_size():
    for column in range(6, 15):  # where the far surface begins, of 20 columns
        edge = np.where(np.arange(20) < column, 2, 1).astype(np.float32) * np.ones((12, 1), "f4")
        wide = Camera(40.0, 40.0, 22.5, 13.5, 46, 28)
        depth, _ = full_size(ConfirmedDepth(edge, np.ones_like(edge)), wide)
        begins = int((depth[14] > 0.75).int().argmax())
        assert abs(begins - 46 / 20 * column) <= 0.5  # px, of the borders between two pixels


def test_the_swept_camera_sees_what_the_camera_sees():
    small = planner({}).camera
    assert (small.width, small.height) == SIZE and small.fx == clip().intrinsics.fx


# Keyframes


def test_a_backdrop_is_one_unit_away_and_nothing_measures_or_confirms_it():
    seen = keyframe(8, torch.zeros(()).expand(SIZE[::-1]))
    [flat] = on_backdrop([seen])
    assert torch.equal(flat.depth, torch.ones(SIZE[::-1])) and flat.confirmation is None
    assert flat.filled is not None and flat.filled.all()


def keyframe(index: int, depth: torch.Tensor) -> MapImage:
    features, T_camera_world = torch.zeros(15, 20, 2), torch.from_numpy(pose(index))
    return MapImage(index, torch.from_numpy(clip().rgb[index]), features, depth, T_camera_world)


def test_swept_depth_comes_first_and_a_prior_of_another_scale_fills_the_rest():
    swept = [
        (torch.from_numpy(seen.depth), torch.from_numpy(seen.confirmation)) for seen in found()[1:3]
    ]
    guesses = [1.3 * depth + (depth == 0) * 7.0 for depth, _ in swept]  # of a network, all known
    keyframes = [keyframe(8 + 8 * k, guess) for k, guess in enumerate(guesses)]
    for found_there, (depth, _) in zip(
        with_swept_depth(camera(), keyframes, swept), swept, strict=True
    ):
        known = depth > 0
        assert 0 < float(known.float().mean()) < 1
        assert torch.equal(found_there.depth[known], depth[known])
        rest = found_there.depth[~known]
        assert float((rest == 0).float().mean()) < 0.01  # others seem to look through a few
        rest = rest[rest > 0]
        torch.testing.assert_close(rest, torch.full_like(rest, 7 / 1.3))
        assert found_there.confirmation is not None
        assert found_there.confirmation.shape == (15, 20)


def test_where_nothing_was_swept_the_prior_stays_as_it_is():
    guess = torch.full(SIZE[::-1], 7.0)
    guess[0] = 0  # and an unknown depth stays unknown
    [after] = with_swept_depth(camera(), [keyframe(8, guess)], [(0 * guess, 0 * guess)])
    assert torch.equal(after.depth, guess)


def test_a_guess_that_other_keyframes_look_through_is_left_out():
    near, wall = torch.full(SIZE[::-1], 1.0), torch.full(SIZE[::-1], 4.0)
    unknown = torch.zeros_like(wall)
    guess = torch.where(torch.arange(160) < 80, near, wall)
    keyframes = [keyframe(8, depth) for depth in (unknown, guess, unknown)]
    seen = wall, torch.ones_like(wall)
    swept = [seen, (unknown, unknown), seen]  # all three from one place
    _, after, _ = with_swept_depth(camera(), keyframes, swept)
    inside = after.depth[2:-2, 2:-2]
    assert not inside[:, :76].any() and (inside[:, 78:] == 4).all()


def test_after_a_pan_the_nearest_known_depth_fills_what_is_unknown_if_that_is_most():
    column, unknown = torch.arange(160).expand(SIZE[::-1]), torch.zeros(SIZE[::-1])
    few = torch.where(column < 30, 2.0, 0.0) + torch.where(column >= 120, 5.0, 0.0)
    swept = [(few, few), (unknown, unknown)]
    keyframes = [keyframe(8, unknown), keyframe(16, unknown)]
    filled, empty = with_swept_depth(camera(), keyframes, swept, fills=True)
    assert torch.equal(filled.depth, torch.where(column < 75, 2.0, 5.0))
    assert filled.filled is not None and torch.equal(filled.filled, few == 0)
    assert not empty.depth.any() and empty.filled is None
    assert torch.equal(with_swept_depth(camera(), keyframes, swept)[0].depth, few)
    most = torch.where(column < 100, 2.0, 0.0)
    [after] = with_swept_depth(camera(), keyframes[:1], [(most, most)], fills=True)
    assert torch.equal(after.depth, most)
