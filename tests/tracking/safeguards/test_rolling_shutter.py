"""The readout of a rolling shutter: undone by the image's own motion, and found as an unknown."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from minislam.geometry import se3_exp
from minislam.priors.interfaces import FlowMatches
from minislam.records import Frame
from minislam.tracking import frame_graph
from minislam.tracking.bundle_adjustment import bundle_adjust
from minislam.tracking.bundle_problem import BundleProblem
from minislam.tracking.frame_graph import FrameGraph
from minislam.tracking.keyframes import KeyframeStore
from minislam.tracking.reference import moved, predicted_positions
from minislam.tracking.reprojection import reproject_with_jacobians
from minislam.tracking.safeguards.robust import RobustKernel
from minislam.tracking.safeguards.rolling_shutter import (
    Readout,
    RollingShutter,
    displacements,
    with_shifts,
)
from tests.helpers import generator
from tests.tracking.safeguards.moving_cloth import GRID, RATE, WIDE, picture, texture
from tests.tracking.scene import (
    CAMERA,
    CELLS,
    RAYS,
    KnownProblem,
    distance,
    known_problem,
    noisy,
    normal,
    perturbed,
    pose_equations,
    two_fixed_poses,
    uniform,
)

READOUT = 0.03, 0.04  # s


def shutter_of(count: int, is_on: bool = True, edges: FrameGraph | None = None) -> RollingShutter:
    """Return the shutter of a store with `count` keyframes, at frames 0, 1, 2, ..."""
    store = KeyframeStore(GRID.rays[:, 0])
    edges = FrameGraph() if edges is None else edges
    shutter = RollingShutter(GRID, store, edges, is_on)
    store.frames = [Frame(index, index / RATE, torch.zeros(120, 160, 3)) for index in range(count)]
    return shutter


# Flow as a global shutter would have seen it


def seen(points: Tensor, time: float, readout: Readout = (0.0, 0.0)) -> Tensor:
    """Return where points (N, 3) are seen (2, N) by a camera that turns and moves ever faster."""
    twist = torch.tensor([0.8, 0.1, 0.2, 0.1, 0.9, 0.3], dtype=torch.float64)  # per second
    size = points.new_tensor([WIDE.width, WIDE.height])
    delay = points.new_zeros(len(points))
    for _ in range(20):
        since = time + delay
        pose = se3_exp((since + 10 * since**2)[:, None] * twist)  # at frame 1 twice as fast
        at = (pose[:, :3, :3] @ points[..., None])[..., 0] + pose[:, :3, 3]
        pixels = WIDE.project(at)
        delay = (pixels / size - 0.5) @ points.new_tensor(readout)
    return pixels.T


@pytest.mark.parametrize("readout", [(0.0, 0.03), (0.03, 0.0), (0.0, -0.03), READOUT])
def test_corrected_flow_is_that_of_a_global_shutter(readout: Readout):
    pixels = GRID.pixels.double()
    depth = 1.5 + uniform(1, len(pixels), 1)
    sought = pixels  # where a global shutter sees what a rolling one sees at the cells
    for _ in range(20):
        sought = sought + pixels - seen(WIDE.rays(sought) * depth, 0.0, readout).T
    rolling = seen(WIDE.rays(sought) * depth, 1 / RATE, readout)
    true = seen(WIDE.rays(pixels) * depth, 1 / RATE)

    def velocity(frame_index: int) -> Tensor:  # of what is seen at the cells, here at depth 2
        time, h, points = frame_index / RATE, 1e-4, WIDE.rays(pixels) * 2.0
        return ((seen(points, time + h) - seen(points, time - h)) / (2 * h)).float()

    shutter = shutter_of(2)
    shutter.readout, shutter.motion.velocity = readout, velocity
    matches = FlowMatches(rolling[None].float(), torch.ones(1, 2, len(pixels)), torch.ones(1))
    corrected = shutter.corrected(matches, [(0, 1)]).targets[0]
    before, after = (rolling - true).abs().mean(), (corrected - true).abs().mean()
    assert after < 0.2 * before, (float(before), float(after))


def test_without_a_readout_matches_stay_as_they_are():
    matches = FlowMatches(GRID.pixels.T[None], torch.ones(1, 2, len(GRID.pixels)), torch.ones(1))
    assert shutter_of(2).corrected(matches, [(0, 1)]) is matches


def test_an_image_that_is_no_keyframe_yet_counts_as_the_next_one():
    shutter = shutter_of(1)
    shutter.motion.velocities = [torch.full_like(GRID.pixels.T, float(index)) for index in range(6)]
    at = GRID.pixels.T[None]
    expected = shutter.columns([(0, 1)], at, next_frame=4)
    shutter._keyframes.frames.append(Frame(4, 4 / RATE, torch.zeros(120, 160, 3)))
    torch.testing.assert_close(shutter.columns([(0, 1)], at), expected)


# The readouts as unknowns of Eq. (5)


def columns(known: KnownProblem) -> Tensor:  # (E, 2, 2, N) px/s
    return 30 * normal(77, len(known.problem.targets), 2, 2, CELLS)


def rolled(known: KnownProblem, readout: Readout) -> BundleProblem:
    """Return the problem whose flow a rolling shutter has seen: targets p~ = p - rho c."""
    c = columns(known)
    targets = known.problem.targets - displacements(c, readout)
    return replace(known.problem, targets=targets, shift_columns=c)


def test_the_columns_are_those_of_finite_differences():
    known = known_problem(3)
    transforms = known.truth.T_camera_world[1:]
    at = reproject_with_jacobians(transforms, known.truth.disparities[1:], RAYS, CAMERA)
    c, h = columns(known)[:2], 1e-3
    J = with_shifts(at, c, READOUT).J_target[:, 6:]
    for axis in range(2):
        ends = [
            tuple(r + sign * h * (k == axis) for k, r in enumerate(READOUT)) for sign in (1, -1)
        ]
        ahead, behind = (with_shifts(at, c, end).positions for end in ends)
        torch.testing.assert_close(J[:, axis], (ahead - behind) / (2 * h), rtol=1e-8, atol=1e-8)
    assert with_shifts(at, None, READOUT) is at


@pytest.mark.slow
@pytest.mark.parametrize("robust", [None, RobustKernel(1.5)])
def test_normal_equations_are_those_of_all_unknowns_at_once(robust: RobustKernel | None):
    known = known_problem(3)
    problem = replace(noisy(known, 0.3), robust=robust, shift_columns=columns(known))
    start = perturbed(known, 0.02)
    poses = 6 * int(problem.free_poses.sum())

    def predicted(step: Tensor) -> Tensor:  # poses, two readouts, disparities
        state = moved(problem, start, torch.cat([step[:poses], step[poses + 2 :]]))
        shift = torch.einsum("eakn,a->ekn", columns(known), step[poses : poses + 2])
        return predicted_positions(problem, state)[0] - shift

    nothing = torch.zeros(poses + 2 + 3 * CELLS, dtype=torch.float64)
    residual = problem.targets - predicted(nothing)
    weight = problem.weights
    if robust is not None:
        weight = weight * robust.weight(residual.square().sum(1, keepdim=True))
    J = torch.autograd.functional.jacobian(predicted, nothing).flatten(0, 2)
    weighted = weight.flatten()[:, None] * J
    matrix, vector = weighted.T @ J, weighted.T @ residual.flatten()
    H, g = pose_equations(problem, start)
    torch.testing.assert_close(H, matrix[: poses + 2, : poses + 2])
    torch.testing.assert_close(g, vector[: poses + 2])


@pytest.mark.parametrize("free_focal", [False, True])
def test_the_true_readouts_are_found_with_poses_and_disparities(free_focal: bool):
    known = two_fixed_poses(known_problem(6))
    problem = replace(rolled(known, READOUT), free_focal=free_focal)
    end, report = bundle_adjust(problem, perturbed(known, 0.01), iterations=60)
    assert end.shifts == pytest.approx(READOUT, abs=1e-6)
    assert distance(end, known.truth) < 1e-4
    assert report.cost_after < 1e-6 * report.cost_before


def test_readouts_that_are_not_free_stay():
    known = known_problem()
    start = replace(perturbed(known, 0.02), shifts=READOUT)
    end, _ = bundle_adjust(known.problem, start, iterations=5)
    assert end.shifts == READOUT


# A new readout corrects what is stored


def linked(is_on: bool = True) -> tuple[RollingShutter, FrameGraph]:
    edges = FrameGraph()
    shutter = shutter_of(2, is_on, edges)
    shutter.motion.velocities = [
        50 * torch.randn(2, len(GRID.pixels), generator=generator(seed)) for seed in range(3)
    ]
    shutter.motion.shortest_step = 1 / RATE
    targets = GRID.pixels.T[None] + torch.ones(2, 1, 1)
    edges.record([(0, 1), (1, 0)], FlowMatches(targets, torch.ones_like(targets), torch.ones(2)))
    return shutter, edges


def test_a_longer_readout_moves_the_targets_of_all_edges():
    shutter, edges = linked()
    before = torch.stack(edges.targets)
    columns = shutter.columns(edges.ends, before)
    shutter.lengthen((0.01, -0.02))
    assert shutter.readout == (0.01, -0.02)
    moved = torch.stack(edges.targets) - before
    torch.testing.assert_close(moved, displacements(columns, (0.01, -0.02)), rtol=0, atol=1e-4)


def test_links_in_parts_are_corrected_like_all_at_once(monkeypatch: pytest.MonkeyPatch):
    (shutter, edges), (other, split) = linked(), linked()
    whole = shutter.edge_columns([1, 0])
    shutter.lengthen((0.01, -0.02))
    monkeypatch.setattr(frame_graph, "AT_ONCE", 1)
    assert torch.equal(other.edge_columns([1, 0]), whole)
    other.lengthen((0.01, -0.02))
    assert all(map(torch.equal, split.targets, edges.targets))


@pytest.mark.parametrize("size", [(160, 120), (160, 200), (160, 160)])
def test_the_readout_along_the_longer_side_is_held(size: tuple[int, int]):
    shutter, edges = linked()
    shutter._grid = replace(GRID, camera=replace(GRID.camera, width=size[0], height=size[1]))
    free, held = (0, 1) if size[0] < size[1] else (1, 0)
    both = shutter.columns(edges.ends, torch.stack(edges.targets))
    found = shutter.edge_columns([0, 1])
    assert both[:, held].any() and not found[:, held].any()
    assert torch.equal(found[:, free], both[:, free])


def test_what_is_taken_is_refined_from_then_on():
    shutter, _ = linked()
    assert not shutter.is_found
    shutter.take((0.0, -0.035))
    assert shutter.is_found and shutter.readout == (0.0, -0.035)


def test_no_readout_is_longer_than_the_time_between_two_frames():
    shutter, _ = linked()
    shutter.lengthen((0.3, -0.3))
    assert shutter.readout == pytest.approx((1 / RATE, -1 / RATE))


def test_where_it_is_off_nothing_is_estimated():
    shutter, _ = linked(is_on=False)
    assert shutter.edge_columns([0, 1]) is None
    shutter.lengthen((0.0, 0.0))
    assert shutter.readout == (0.0, 0.0)
    shutter.see(picture(0, 0))
    shutter.see(picture(1, 5))
    assert len(shutter.motion.velocities) == 3  # those of before


# Images


def test_an_image_is_undone():
    shutter, speed = shutter_of(0), 60.0
    shutter.readout = (0.0, 0.04)
    u = torch.zeros_like(GRID.pixels.T)
    u[0] = speed
    shutter.motion.velocities = [u, u]
    frame = picture(0, speed * (np.arange(120)[:, None] / 120 - 0.5) * 0.04)
    inner = np.s_[8:-8, 8:-8]
    images = [image.numpy()[inner] for image in (frame.image, shutter.undone(frame).image)]
    error = [np.abs(image - texture(0.0)[inner]).mean() for image in images]
    assert error[1] < 0.1 * error[0], error


def test_an_image_that_hardly_moved_is_left_alone():
    shutter, frame = shutter_of(0), picture(0, 0)
    assert shutter.undone(frame) is frame
    shutter.readout = (0.0, 0.001)
    shutter.motion.velocities = [torch.full_like(GRID.pixels.T, 60.0)] * 2  # .03 px at most
    assert shutter.undone(frame) is frame


def test_a_readout_that_is_taken_back_leaves_no_trace():
    shutter, edges = linked()
    before = torch.stack(edges.targets)
    shutter.lengthen((0.01, -0.02))
    shutter.lengthen((-0.01, 0.02))
    left = (torch.stack(edges.targets) - before).abs()
    assert left.mean() < 0.01  # px; not 0, because each target has moved to other velocities
