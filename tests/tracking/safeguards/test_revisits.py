"""A loop that drift hides: what moves, by how much, and what is no loop."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from minislam.geometry import se3_exp, se3_inverse, se3_log
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.loop_closure import close_loops
from minislam.tracking.safeguards.relocalisation import Place, Relocaliser
from minislam.tracking.safeguards.revisits import MOST_DRIFT, spread, undo_drift
from tests.tracking.test_loop_closure import CONFIG, ROUND, FlowThatNeverFits, drifted, end_error
from tests.tracking.wall import TrueFlow, true_poses

NEAR = replace(CONFIG, loop_distance=3.0)  # px: less than the drift


class FoundPlace(Relocaliser):
    """A relocaliser that finds the first keyframe, from where the newest one truly is."""

    def __init__(self, graph: KeyframeGraph, T_camera_world: Tensor | None = None) -> None:
        super().__init__(graph)
        self.pose = true_poses()[ROUND[-1]] if T_camera_world is None else T_camera_world

    def find(self, image: Tensor, features: Tensor, older: int | None = None) -> Place | None:
        assert older == len(ROUND) - 1 - CONFIG.loop_min_gap
        return Place(0, self.pose, 99)


def far_graph(flow: TrueFlow | None = None) -> KeyframeGraph:
    graph = drifted(flow or TrueFlow())
    graph.config = NEAR
    return graph


def way(count: int = 7) -> Tensor:
    """Return a way of cameras that turn as they walk, (K, 4, 4)."""
    steps = torch.tensor([0.2, 0.05, 0.1, 0.02, 0.2, -0.05], dtype=torch.float64)
    return se3_exp(torch.arange(count)[:, None] * steps)


def test_drift_is_spread_evenly_over_the_way_and_what_came_before_stays():
    poses, disparities = way(), torch.linspace(0.5, 2, 7 * 3).view(7, 3)
    slip = se3_exp(torch.tensor([0.03, -0.02, 0.01, 0.03, -0.06, 0.03], dtype=torch.float64))
    moved, same = spread(poses, disparities, 2, slip @ poses[-1], scale=1.0)
    assert torch.equal(moved[:3], poses[:3]) and torch.equal(same, disparities)
    torch.testing.assert_close(moved[-1], slip @ poses[-1])
    # Each camera moves by as much more as the one before it, in the old one's coordinates.
    seen = poses[2] @ se3_inverse(moved[2:]), poses[2] @ se3_inverse(poses[2:])
    shifts = se3_log(seen[0] @ se3_inverse(seen[1]))
    torch.testing.assert_close(shifts.diff(dim=0), shifts[-1:].expand(4, 6) / 4)


def test_a_drift_of_scale_alone_changes_steps_and_depths_together():
    poses, disparities = way(), torch.linspace(0.5, 2, 7 * 3).view(7, 3)
    factors = 1.2 ** torch.tensor([0.0, 0, 0, 0.25, 0.5, 0.75, 1], dtype=torch.float64)
    centres = se3_inverse(poses)[:, :3, 3]
    steps = centres.diff(dim=0)
    true_centres = torch.cat([centres[:1], centres[0] + (steps * factors[1:, None]).cumsum(0)])
    true = se3_inverse(poses)
    true[:, :3, 3] = true_centres
    true = se3_inverse(true)
    moved, scaled = spread(poses, disparities, 2, true[-1], scale=1.2)
    torch.testing.assert_close(moved, true)
    torch.testing.assert_close(scaled, disparities / factors[:, None].float())


def test_a_loop_that_drift_hides_is_closed_by_its_appearance():
    graph = far_graph()
    before = end_error(graph)
    assert not close_loops(graph)  # the geometry predicts none
    assert end_error(graph) == before and (8, 0) not in graph.edges.ends
    assert close_loops(graph, FoundPlace(graph))
    assert (8, 0) in graph.edges.ends and (0, 8) in graph.edges.ends
    assert end_error(graph) < 0.05 * before


def test_what_the_flow_does_not_confirm_is_undone():
    graph = far_graph(FlowThatNeverFits())
    state, edges = graph.state, list(graph.edges.ends)
    assert not close_loops(graph, FoundPlace(graph))
    assert torch.equal(graph.state.T_camera_world, state.T_camera_world)
    assert torch.equal(graph.state.disparities, state.disparities)
    assert graph.edges.ends == edges


@pytest.mark.parametrize("part", [slice(0, 3), slice(3, 6)])
def test_a_place_that_is_too_far_off_for_drift_only_looks_alike(part: slice):
    graph = far_graph()
    poses = graph.keyframes.T_camera_world
    steps = se3_log(poses[1:] @ se3_inverse(poses[:-1]))
    way = float(steps[:, part].norm(dim=1).sum())  # about the same as by `_motion`
    slip = torch.zeros(6, dtype=torch.float64)
    for times, is_found in (0.8, True), (1.2, False):
        slip[part] = times * MOST_DRIFT * way / 3**0.5
        place = FoundPlace(graph, se3_exp(slip) @ poses[-1])
        assert undo_drift(far_graph(), place) is is_found, times


def test_a_depth_that_has_shrunk_on_the_way_grows_again():
    graph = far_graph()
    graph.keyframes.disparities[8] *= 1.1
    assert undo_drift(graph, FoundPlace(graph))
    fresh = far_graph().keyframes.disparities
    assert float((graph.keyframes.disparities[8] / fresh[8]).median()) == pytest.approx(1, abs=0.02)


def test_only_every_second_keyframe_looks_for_a_place():
    graph = drifted(TrueFlow(), ROUND[:8])
    assert not undo_drift(graph, FoundPlace(graph))
