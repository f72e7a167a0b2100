"""What the classical flow remembers: an edge is measured again only from another start."""

import numpy as np
import pytest
import torch
from torch import Tensor

from minislam.priors import dense_flow
from minislam.priors import flow as classical
from tests.priors.patterns import SIZE, flow_of, shifted, still


def aside(tolerances: float) -> Tensor:
    """Return two starts that lie to the right by so many tolerances."""
    return still(2) + torch.tensor([[tolerances * classical.START_TOLERANCE], [0]])


def counting(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return a list that grows by one with every dense flow."""
    calls, compute = [], dense_flow.residual_flow

    def counted(*images: np.ndarray) -> np.ndarray:
        calls.append(1)
        return compute(*images)

    monkeypatch.setattr(dense_flow, "residual_flow", counted)
    return calls


def test_an_edge_is_measured_again_only_if_its_start_has_moved(monkeypatch: pytest.MonkeyPatch):
    flow = flow_of([shifted(d, 0, SIZE) for d in (0, 3)])
    calls = counting(monkeypatch)
    first = flow.match([0, 1], [1, 0], still(2))
    again = flow.match([1, 0], [0, 1], aside(0.99))
    assert len(calls) == 2
    assert torch.equal(first.targets, again.targets.flip(0))
    assert torch.equal(first.confidences, again.confidences.flip(0))
    assert torch.equal(first.matched_ratios, again.matched_ratios.flip(0))
    one_moved = torch.stack([still()[0], aside(1.01)[1]])
    flow.match([0, 1], [1, 0], one_moved)
    assert len(calls) == 4  # the other direction with it: each is the check of the other


def test_small_steps_of_a_start_add_up(monkeypatch: pytest.MonkeyPatch):
    flow = flow_of([shifted(d, 0, SIZE) for d in (0, 3)])
    calls = counting(monkeypatch)
    for step in range(4):
        flow.match([0, 1], [1, 0], aside(0.4 * step))
    assert len(calls) == 4  # at the first and at the last


def test_without_tolerance_everything_is_measured_again(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(classical, "START_TOLERANCE", 0.0)
    flow = flow_of([shifted(d, 0, SIZE) for d in (0, 3)])
    calls = counting(monkeypatch)
    for _ in range(3):
        flow.match([0, 1], [1, 0], still(2))
    assert len(calls) == 6


def test_what_was_measured_is_part_of_the_state(monkeypatch: pytest.MonkeyPatch):
    images = [shifted(d, 0, SIZE) for d in (0, 3)]
    flow, other = flow_of(images), flow_of(images)
    first = flow.match([0, 1], [1, 0], still(2) + 1)
    other.match([0, 1], [1, 0], still(2))
    other.restore_state(flow.saved_state(), lambda index: None)
    calls = counting(monkeypatch)
    assert torch.equal(other.match([0, 1], [1, 0], still(2) + 1).targets, first.targets)
    assert not calls


def test_a_forgotten_keyframe_takes_its_edges_along():
    flow = flow_of([shifted(d, 0, SIZE) for d in (0, 3)])
    before = flow.match([0], [1], still())
    flow.remove_frame(1)
    flow.add_frame(1, shifted(5, 0, SIZE))
    after = flow.match([0], [1], still())
    moved = (after.targets - before.targets)[:, 0].median()
    assert float(moved) == pytest.approx(2, abs=0.1)
