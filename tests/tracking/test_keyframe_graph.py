"""Links of the keyframe graph on exact flow: what is confirmed, and how far keyframes are apart."""

import pytest
import torch

from minislam.tracking.config import TrackingConfig
from tests.tracking.wall import TrueFlow, true_graph

# What is refused


def test_a_new_link_needs_both_directions():
    flow = TrueFlow(ratios={(0, 3): 0.9, (3, 0): 0.05, (1, 3): 0.5, (3, 1): 0.4})
    graph = true_graph([0, 1, 2, 3], TrackingConfig(min_link_ratio=0.1), flow)
    asked = [(0, 3), (3, 0), (1, 3), (3, 1)]
    assert graph.filter_confirmed(asked) == [(1, 3), (3, 1)]
    assert graph.filter_confirmed([]) == [] and len(graph.links) == 0


@pytest.mark.parametrize("has_prior", [False, True])
def test_flow_back_from_the_newest_keyframe_is_measured_where_no_prior_gives_its_depth(
    has_prior: bool,
):
    graph = true_graph([0, 1, 2])
    graph.keyframes.metric_depths[0] = torch.ones(1, 1) if has_prior else None
    graph.match_composed(2)
    expected = [(1, 2), (0, 2)] if has_prior else [(1, 2), (2, 1), (0, 2), (2, 0)]
    assert graph.links.edges() == expected
