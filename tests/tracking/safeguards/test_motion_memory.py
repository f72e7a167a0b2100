"""Trust in cells: lost where they do not follow the camera, warped along, regained slowly."""

from types import SimpleNamespace

import torch

from minislam.geometry import se3_exp
from minislam.priors.interfaces import FlowMatches
from minislam.tracking.grid import Grid
from minislam.tracking.keyframes import KeyframeStore
from minislam.tracking.reprojection import reproject
from minislam.tracking.safeguards.motion_memory import (
    arrived,
    inherit_motion_weight,
    judge_all,
    remember,
    update_motion_weight,
)
from tests.tracking.scene import CAMERA, STRIDE
from tests.tracking.wall import wall_frame

GRID = Grid.of(CAMERA, STRIDE)
CELLS = len(GRID.rays)
DISPARITIES = torch.full((CELLS,), 0.5)
MOTION = se3_exp(torch.tensor([0.1, -0.05, 0.02, 0.01, -0.02, 0.005], dtype=torch.float64))
SCALE = 3.0  # px


def matches_of(shift: torch.Tensor, confidence: float = 1.0) -> FlowMatches:
    """Return what a camera that moved by MOTION sees, each cell off by `shift` (N, 2) px."""
    rays, pose = GRID.rays.float(), MOTION[None].float()
    positions, _ = reproject(pose, DISPARITIES[None], rays, CAMERA)
    targets = (positions[0].mT + shift).T[None]
    return FlowMatches(targets, torch.full_like(targets, confidence), torch.ones(1))


def test_what_follows_the_camera_keeps_its_weight():
    kept = update_motion_weight(
        GRID, matches_of(torch.zeros(CELLS, 2)), DISPARITIES, MOTION, torch.ones(CELLS), SCALE
    )
    torch.testing.assert_close(kept, torch.ones(CELLS), atol=1e-4, rtol=0)


def test_a_mover_loses_it_at_once_and_regains_it_slowly():
    moves = torch.zeros(CELLS, 2)
    moves[: CELLS // 2] = torch.tensor([30.0, 0.0])
    lost = update_motion_weight(
        GRID, matches_of(moves), DISPARITIES, MOTION, torch.ones(CELLS), SCALE
    )
    assert lost[: CELLS // 2].max() < 0.15
    assert lost[CELLS // 2 :].min() > 0.99
    rests = matches_of(torch.zeros(CELLS, 2))
    regained = update_motion_weight(GRID, rests, DISPARITIES, MOTION, lost, SCALE)
    assert 0.15 < float(regained[0]) < 0.25


def test_the_agreement_halves_where_the_kernel_says():
    # (1 + r^2 / c^2)^-2 = 1/4 at r = c, and nine tenths of the way are gone at once. At infinity
    # there is no parallax, which would widen c.
    off = torch.tensor([SCALE, 0.0]).expand(CELLS, 2)
    positions, _ = reproject(MOTION[None].float(), torch.zeros(1, CELLS), GRID.rays, CAMERA)
    matches = FlowMatches(positions + off.T, torch.ones(1, 2, CELLS), torch.ones(1))
    far, ones = torch.zeros(CELLS), torch.ones(CELLS)
    weight = update_motion_weight(GRID, matches, far, MOTION, ones, SCALE)
    torch.testing.assert_close(weight, torch.full((CELLS,), 0.1 + 0.9 / 4), atol=1e-4, rtol=0)


def test_an_error_of_depth_is_no_motion_on_a_wide_step():
    # 20 px of parallax from a depth that is 8 % off: 1.6 px, against a scale of 0.5 px.
    slide = se3_exp(torch.tensor([20 / (60 * 0.5), 0, 0, 0, 0, 0], dtype=torch.float64))
    seen, _ = reproject(slide[None].float(), DISPARITIES[None], GRID.rays, CAMERA)
    matches = FlowMatches(seen, torch.ones(1, 2, CELLS), torch.ones(1))
    known = DISPARITIES * 1.08
    weight = update_motion_weight(GRID, matches, known, slide, torch.ones(CELLS), 0.5)
    assert weight.min() > 0.4
    still = update_motion_weight(GRID, matches, known, slide, torch.ones(CELLS), 0.05)
    assert still.min() > 0.3  # the parallax alone decides there


def test_cells_without_a_match_keep_what_they_had():
    weight = torch.linspace(0, 1, CELLS)
    off = torch.full((CELLS, 2), 50.0)
    unseen = matches_of(off, confidence=0.0)
    assert torch.equal(
        update_motion_weight(GRID, unseen, DISPARITIES, MOTION, weight, SCALE), weight
    )
    assert torch.equal(inherit_motion_weight(GRID, unseen, weight), torch.ones(CELLS))


def test_the_weight_moves_with_the_flow():
    height, width = GRID.shape
    weight = torch.ones(height, width)
    weight[2:4, 1:3] = 0.1
    right = GRID.pixels.float().T[None] + torch.tensor([[2.0 * STRIDE], [0.0]])
    matches = FlowMatches(right, torch.ones_like(right), torch.ones(1))
    warped = inherit_motion_weight(GRID, matches, weight.reshape(-1)).reshape(height, width)
    expected = torch.ones(height, width)
    expected[2:4, 3:5] = 0.1
    assert torch.equal(warped[:, 2:], expected[:, 2:])
    assert torch.equal(warped[:, :2], expected[:, 2:3].expand(-1, 2))  # nothing flowed there


def test_where_two_cells_meet_the_lower_weight_counts():
    everything_to_one = torch.zeros(1, 2, CELLS)
    matches = FlowMatches(everything_to_one, torch.ones(1, 2, CELLS), torch.ones(1))
    warped = inherit_motion_weight(GRID, matches, torch.linspace(0.2, 1, CELLS))
    torch.testing.assert_close(warped, torch.full((CELLS,), 0.2))


def store_of(count: int) -> KeyframeStore:
    """Return keyframes, each moved on by MOTION, whose motion weights are not one."""
    store = KeyframeStore(GRID.rays[:, 0])
    pose = torch.eye(4, dtype=torch.float64)
    for index in range(count):
        store.append(wall_frame(index), torch.zeros(1), None, pose, DISPARITIES, DISPARITIES)
        store.motion_weights[index] = torch.full((CELLS,), 0.5)
        pose = MOTION @ pose
    return store


def graph_of(store: KeyframeStore, flow: list, scale: float = SCALE) -> SimpleNamespace:
    """Return the part of a keyframe graph that the motion memory sees."""
    config = SimpleNamespace(motion_memory=scale / 2)  # px at 320x240
    known = {"grid": GRID, "keyframes": store, "flow_to_next": flow}
    return SimpleNamespace(config=config, pixel_scale=2.0, **known)


def test_all_keyframes_are_judged_anew_from_the_first_on():
    moves = torch.zeros(CELLS, 2)
    moves[: CELLS // 2] = torch.tensor([30.0, 0.0])
    flow = [matches_of(moves), matches_of(moves)]
    store = store_of(3)
    graph = graph_of(store, flow)
    judge_all(graph)
    first = update_motion_weight(GRID, flow[0], DISPARITIES, MOTION, torch.ones(CELLS), SCALE)
    assert torch.equal(store.motion_weights[0], first)
    second = inherit_motion_weight(GRID, flow[0], first)
    judged = update_motion_weight(GRID, flow[1], DISPARITIES, MOTION, second, SCALE)
    torch.testing.assert_close(store.motion_weights[1], judged)
    assert torch.equal(store.motion_weights[2], inherit_motion_weight(GRID, flow[1], judged))
    before = store.motion_weights.clone()
    judge_all(graph)  # what was judged before has no effect
    assert torch.equal(store.motion_weights, before)


def test_memory_begins_anew_where_the_camera_was_relocalised():
    off = torch.full((CELLS, 2), 30.0)
    store = store_of(3)
    judge_all(graph_of(store, [matches_of(off), None]))
    assert store.motion_weights[0].max() < 0.15 and store.motion_weights[2].min() == 1


def test_no_scale_is_no_memory():
    store = store_of(2)
    judge_all(graph_of(store, [matches_of(torch.full((CELLS, 2), 30.0))], scale=0.0))
    assert store.motion_weights[0].min() == 1


def test_a_cell_whose_disparity_is_unknown_keeps_its_weight():
    store, settled = store_of(2), torch.arange(CELLS) % 2 == 0
    moves = matches_of(torch.full((CELLS, 2), 30.0))
    graph = graph_of(store, [moves])
    remember(graph, moves, store.T_camera_world[1], index=0, settled=settled)
    judged = store.motion_weights[0]
    assert judged[settled].max() < 0.15
    assert torch.equal(judged[~settled], torch.full_like(judged[~settled], 0.5))


def test_marks_arrive_where_they_flow_to_and_just_beside():
    marks = torch.zeros(GRID.shape)
    marks[4, 4] = 1
    still = FlowMatches(GRID.pixels.T[None], torch.ones(1, 2, CELLS), torch.ones(1))
    assert torch.equal(arrived(GRID, still, marks.flatten()).reshape(GRID.shape), marks)
    still.confidences[0, :, marks.flatten() == 0] = 0  # one cell flows: it fills the 3 x 3 around
    found = arrived(GRID, still, marks.flatten()).reshape(GRID.shape)
    assert found[3:6, 3:6].min() == 1 and found.sum() == 9
    assert arrived(GRID, still, 0 * marks.flatten()).max() == 0
