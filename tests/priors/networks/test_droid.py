"""DROID-SLAM as a FlowEstimator: units, hidden states, batches, files.

The weights are made up, so nothing is asked of the quality of the flow; that the network is the
official one is test_droid_network.py's matter.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
import torch

from minislam.errors import InputError
from minislam.geometry import Camera
from minislam.priors.depth import SensorDepth
from minislam.priors.features import ClassicalFeatures
from minislam.priors.networks import droid
from minislam.priors.networks.checkpoints import Weights
from minislam.priors.networks.droid import DroidFlow, DroidFlowConfig, as_matches
from minislam.priors.networks.droid_network import cell_grid, update
from minislam.records import Frame
from minislam.tracking.config import LearnedFlowConfig, TrackingConfig
from minislam.tracking.tracker import Tracker
from tests.priors.networks import rebuilt
from tests.priors.networks.test_droid_network import moving_image

pytestmark = pytest.mark.slow

HEIGHT, WIDTH = 66, 90  # no multiples of 8: 9 x 12 cells


@cache
def weights() -> Weights:
    return rebuilt.weights_of("droid")


def image(frame: int) -> torch.Tensor:
    return moving_image(frame, HEIGHT, WIDTH)


def flow_with_frames(**settings: int) -> DroidFlow:
    flow = DroidFlow(weights(), DroidFlowConfig(**settings))
    for frame in range(3):
        flow.add_frame(frame, image(frame))
    return flow


def still(edges: int = 1) -> torch.Tensor:
    """Return predicted targets (E, 2, N) [px] of a camera that does not move."""
    grid = Camera(50, 50, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT).pixel_grid(DroidFlow.stride)
    return grid.flatten(0, 1).T.expand(edges, 2, -1).clone()


# Known answers


@torch.inference_mode()
def test_matches_are_the_networks_answer_in_pixels():
    flow = flow_with_frames()
    matches = flow.match([0], [1], still())
    source, target = flow.encode(image(0)), flow.encode(image(1))
    expected = cell_grid(torch.zeros(1, 9, 12, 2))[None]
    both = source.features, target.features
    _, targets, confidences = update(weights(), *both, *source.context, expected, expected)
    torch.testing.assert_close(matches.targets, 8 * targets.flatten(1, 2).mT)
    torch.testing.assert_close(matches.confidences, confidences.flatten(1, 2).mT)


def test_the_grid_is_that_of_the_camera():
    matches = flow_with_frames().match([0, 2], [1, 0], still(2))
    assert matches.targets.shape == still(2).shape == (2, 2, 9 * 12)
    assert matches.matched_ratios.shape == (2,)
    assert ((matches.confidences > 0) & (matches.confidences < 1)).all()


@pytest.mark.parametrize("highest", [0.9, 0.01])
def test_cells_that_leave_the_image_or_are_less_sure_than_others_are_not_matched(highest: float):
    targets = torch.tensor([[[[0.0, 0], [1, 1]], [[-0.1, 0], [1, 0]]]])
    confidences = highest * torch.tensor([[[[1.0, 1.0], [1.0, 1.0]], [[1.0, 1.0], [0.05, 0.1]]]])
    assert as_matches(targets, confidences, targets).matched_ratios.tolist() == [0.5]


def test_a_source_is_damped_by_all_its_edges_and_in_square_pixels():
    flow = flow_with_frames()
    flow.match([0, 0, 2], [1, 2, 1], still(3))
    found = flow.disparity_damping(4)
    hidden = torch.stack([flow._edges[edge][0] for edge in [(0, 1), (0, 2)]])
    # 0.2 eta on 0.001 of the confidence and squared cells: 0.2 * 1000 * 64 on our scale.
    torch.testing.assert_close(found[0], 12800 * flow.damping(hidden).flatten())
    assert found.shape == (4, 9 * 12) and (found[2] > 0).all()
    assert not found[[1, 3]].any()  # no source so far


# Identities


def test_batches_do_not_change_the_answer():
    sources, targets = [0, 1, 0, 2, 1], [1, 0, 2, 1, 2]
    whole = flow_with_frames(edges_per_batch=8).match(sources, targets, still(5))
    parts = flow_with_frames(edges_per_batch=2).match(sources, targets, still(5))
    torch.testing.assert_close(whole.targets, parts.targets, atol=1e-4, rtol=0)
    torch.testing.assert_close(whole.confidences, parts.confidences, atol=1e-5, rtol=0)


def test_the_hidden_state_lives_on_until_as_many_other_edges_were_used():
    flow = flow_with_frames(kept_edges=2)
    first, second = (flow.match([0], [1], still()).targets for _ in range(2))
    assert not torch.equal(first, second)
    flow.match([1], [2], still())
    third = flow.match([0], [1], still()).targets
    assert not torch.equal(first, third) and not torch.equal(second, third)
    flow.match([1, 2], [2, 0], still(2))  # now two edges were used since
    assert torch.equal(first, flow.match([0], [1], still()).targets)


def test_an_image_is_encoded_once_and_its_context_only_as_a_source(
    monkeypatch: pytest.MonkeyPatch,
):
    def counted(name: str, encode: Callable) -> Callable:
        return lambda *arguments: calls.append(name) or encode(*arguments)

    calls: list[str] = []
    for name in ("encode_features", "encode_context"):
        monkeypatch.setattr(droid.net, name, counted(name, getattr(droid.net, name)))
    flow, images = DroidFlow(weights()), [image(frame) for frame in range(3)]
    chain = flow.start_chain(images[0])
    flow.add_frame(0, images[0])
    for frame in (1, 2):
        chain, _ = chain.advance(images[frame])
    flow.add_frame(1, images[2])
    chain.restart().advance(images[2])
    flow.match([0, 1], [1, 0], still(2))
    assert sorted(calls) == 2 * ["encode_context"] + 3 * ["encode_features"]


def test_a_removed_frame_is_gone_and_its_index_can_be_used_again():
    flow = flow_with_frames()
    first = flow.match([0, 1], [1, 2], still(2))
    flow.remove_frame(1)
    with pytest.raises(KeyError):
        flow.match([0], [1], still())
    flow.add_frame(1, image(1))
    assert torch.equal(first.targets, flow.match([0, 1], [1, 2], still(2)).targets)


def test_a_chain_never_changes_and_restarts_at_its_newest_image():
    flow = flow_with_frames()
    start = flow.start_chain(image(0))
    once, matches = start.advance(image(1))
    again, repeated = start.advance(image(1))
    assert torch.equal(matches.targets, repeated.targets)
    assert matches.targets.shape == (1, 2, 9 * 12)
    _, continued = once.advance(image(2))
    _, direct = start.advance(image(2))
    assert not torch.equal(continued.targets, direct.targets)  # it starts where the last one ended
    _, from_newest = again.restart().advance(image(2))
    _, fresh = flow.start_chain(image(1)).advance(image(2))
    assert torch.equal(from_newest.targets, fresh.targets)


def test_a_chain_that_does_not_follow_starts_from_the_identity():
    flow = flow_with_frames(chain_updates=1)
    chain, _ = flow.start_chain(image(0)).advance(image(1))
    found = chain.advance(image(2))[1].targets
    assert torch.equal(found, flow.start_chain(image(0)).advance(image(2))[1].targets)
    assert torch.equal(found, flow.match([0], [2], still()).targets)


@torch.inference_mode()
def test_flow_and_chain_go_on_from_a_saved_state():
    flow, frames = flow_with_frames(), [Frame(k, 0.1 * k, image(k)) for k in range(3)]
    flow.match([0, 1], [1, 2], still(2))
    chain, _ = flow.start_chain(image(0)).advance(image(1))
    other = flow_with_frames()
    other.restore_state(flow.saved_state(), frames.__getitem__)
    resumed = other.restore_chain(chain.saved_state(), frames.__getitem__)
    expected, found = (f.match([1], [2], still()) for f in (flow, other))
    assert torch.equal(found.targets, expected.targets)
    assert torch.equal(flow.disparity_damping(3), other.disparity_damping(3))
    (_, expected), (_, found) = (c.advance(image(2)) for c in (chain, resumed))
    assert torch.equal(found.targets, expected.targets)
    afresh = flow_with_frames().match([1], [2], still())
    assert not torch.equal(afresh.targets, flow.match([1], [2], still()).targets)


def test_matches_are_ordinary_tensors_of_the_callers_kind():
    matches = flow_with_frames().match([0], [1], still().double())
    assert not matches.targets.requires_grad
    assert matches.targets.dtype == torch.float64
    (matches.targets * torch.ones(2, 1, dtype=torch.float64, requires_grad=True)).sum().backward()


def test_the_tracker_runs_on_it_from_warm_up_to_the_last_adjustment():
    # Made-up weights see no motion worth the name: scaled down, they at least keep it small.
    tensors = {name: weights()[name] for name in weights()}
    for kind in ("weight", "bias"):
        tensors[f"update.delta.2.{kind}"] = 0.01 * tensors[f"update.delta.2.{kind}"]
    camera = Camera(80, 80, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    schedule = LearnedFlowConfig(
        warmup_rounds=1, warmup_rounds_with_beta=1, rounds=1, final_rounds=1, pose_rounds=1
    )
    config = TrackingConfig(warmup_keyframes=3, keyframe_interval=1, learned=schedule)
    depth = SensorDepth(lambda frame_index: np.full((HEIGHT, WIDTH), 2.0))
    flow = DroidFlow(Weights(tensors, "droid.pth"), DroidFlowConfig(chain_updates=1))
    tracker = Tracker(
        camera, config, flow, ClassicalFeatures(), depth, lambda index: torch.ones(9 * 12)
    )
    for index in range(5):
        tracker.track(Frame(index, index / 10, image(index)))
        if index == 2:
            tracker.initialise()
            tracker.refine_initialisation()
    tracker.finish()
    assert len(tracker.keyframes) == 5
    assert torch.isfinite(tracker.keyframes.T_camera_world).all()


# Degenerate input


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_textureless_images_give_finite_matches(value: float):
    flow = DroidFlow(weights())
    flow.add_frame(0, torch.full((64, 64, 3), value))
    flow.add_frame(1, torch.full((64, 64, 3), value))
    predicted = 1e6 * torch.ones(1, 2, 8 * 8)  # far outside
    matches = flow.match([0], [1], predicted)
    assert torch.isfinite(matches.targets).all() and torch.isfinite(matches.confidences).all()
    assert matches.matched_ratios.tolist() == [0.0]


# Errors


def test_too_small_an_image_is_refused():
    with pytest.raises(InputError, match=r"more than 56 px per side for DROID, found 80x56"):
        DroidFlow(weights()).add_frame(0, torch.zeros(56, 80, 3))
