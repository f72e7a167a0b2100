"""What the links of a keyframe say about it."""

import torch

from minislam.geometry import se3_exp
from minislam.tracking.config import TrackingConfig
from minislam.tracking.frame_graph import neighbourhood_edges
from minislam.tracking.optimisation import adjust
from minislam.tracking.safeguards.diagnostics import diagnose
from tests.tracking.wall import true_graph


def test_at_the_truth_all_is_matched_and_there_is_parallax():
    graph = true_graph([0, 1, 2])
    graph.match(neighbourhood_edges(0, 3, 2))
    found = diagnose(graph, 2)
    assert found.frame_index == 2 and found.matched_ratio == 1
    assert found.parallax > 3


def test_a_turning_camera_has_no_parallax_and_keeps_its_disparities():
    graph = true_graph([0, 1, 2], TrackingConfig(robust_scale=0))
    poses = graph.keyframes.T_camera_world
    poses[2] = se3_exp(torch.tensor([0, 0, 0, 0.01, 0.02, 0], dtype=torch.float64)) @ poses[1]
    graph.match([(2, 1), (1, 2)])
    assert diagnose(graph, 2).parallax < 0.1
    before = graph.keyframes.disparities.clone()
    adjust(graph, first_free=2, iterations=3)
    assert torch.equal(graph.keyframes.disparities, before)


def test_a_keyframe_without_links_is_reported_as_such():
    found = diagnose(true_graph([0, 1]), 1)
    assert found.matched_ratio == 0 and found.parallax == 0
