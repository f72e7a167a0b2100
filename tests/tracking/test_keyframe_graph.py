"""Links of the keyframe graph on exact flow: what is confirmed, and how far keyframes are apart."""

import pytest
import torch

from minislam.geometry import se3_exp
from minislam.tracking.config import TrackingConfig
from tests.tracking.wall import TrueFlow, true_graph

# What is refused


def test_a_new_link_needs_both_directions():
    flow = TrueFlow(ratios={(0, 3): 0.9, (3, 0): 0.05, (1, 3): 0.5, (3, 1): 0.4})
    graph = true_graph([0, 1, 2, 3], TrackingConfig(min_link_ratio=0.1), flow)
    asked = [(0, 3), (3, 0), (1, 3), (3, 1)]
    assert graph.filter_confirmed(asked) == [(1, 3), (3, 1)]
    assert graph.filter_confirmed([]) == [] and len(graph.links) == 0


@pytest.mark.parametrize("moved", [0.0, 0.05])
def test_distance_to_the_newest_keyframe(moved: float):
    graph = true_graph([0, 1])
    slide = torch.tensor([moved, 0, 0, 0, 0, 0], dtype=torch.float64)
    pose = se3_exp(slide) @ graph.keyframes.T_camera_world[-1]
    expected = moved * 60.0 * float(graph.keyframes.disparities[-1].mean())  # fx t d
    assert graph.distance_to_newest(pose) == pytest.approx(expected, rel=0.05, abs=1e-6)


@pytest.mark.parametrize("has_prior", [False, True])
def test_flow_back_from_the_newest_keyframe_is_measured_where_no_prior_gives_its_depth(
    has_prior: bool,
):
    graph = true_graph([0, 1, 2])
    graph.keyframes.metric_depths[0] = torch.ones(1, 1) if has_prior else None
    graph.match_composed(2)
    expected = [(1, 2), (0, 2)] if has_prior else [(1, 2), (2, 1), (0, 2), (2, 0)]
    assert graph.links.edges() == expected
