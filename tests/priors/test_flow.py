"""Classical flow: known displacements between keyframes, and chains."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from minislam.geometry import Camera
from minislam.priors import dense_flow
from minislam.priors.dense_flow import composed_flow, grayscale, pixel_positions
from minislam.priors.flow import STRIDE, ClassicalChain
from minislam.state import memory, threads
from minislam.state.memory import SHELF
from tests.priors.patterns import (
    GRID,
    HEIGHT,
    SIZE,
    WIDTH,
    constant,
    flow_of,
    on_grid,
    shifted,
    still,
    view,
)

# Known answers


@pytest.mark.parametrize("shift", [(3.0, -2.0), (0.5, 0.25), (-9.0, 6.0)])
def test_a_shift_is_found(shift: tuple[float, float]):
    flow = flow_of([shifted(0, 0, SIZE), shifted(*shift, SIZE)])
    matches = flow.match([0, 1], [1, 0], still(2))
    for edge, sign in ((0, 1), (1, -1)):
        error = (on_grid(matches.targets)[edge] - GRID - sign * torch.tensor(shift)).norm(dim=-1)
        sure = on_grid(matches.confidences)[edge, ..., 0] > 0.5
        assert sure.float().mean() > 0.6
        assert error[sure].median() < 0.1 and error[sure].max() < 1.0


def test_a_rotation_about_the_image_centre_is_found():
    angle, centre = 0.08, np.array([WIDTH / 2, HEIGHT / 2])
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    # What is at p moves to R (p - c) + c, so the image shows at q what was at R^T (q - c) + c.
    turned = view(R.T, centre - R.T @ centre, SIZE)
    matches = flow_of([shifted(0, 0, SIZE), turned]).match([0], [1], still())
    expected = (GRID.numpy() - centre) @ R.T + centre
    error = np.linalg.norm(on_grid(matches.targets)[0].numpy() - expected, axis=-1)
    sure = on_grid(matches.confidences)[0, ..., 0].numpy() > 0.5
    assert sure.mean() > 0.6 and np.median(error[sure]) < 0.15


def test_a_long_shift_needs_the_prediction():
    shift = torch.tensor([46.0, -10.0])
    flow = flow_of([shifted(0, 0, SIZE), shifted(*shift.tolist(), SIZE)])
    lost = flow.match([0], [1], still())
    found = flow.match([0], [1], still() + (shift + torch.tensor([5.0, 4.0]))[:, None])
    stays = GRID[..., 0] + 46 < WIDTH - 8
    stays &= GRID[..., 1] > 18
    errors = [(on_grid(m.targets)[0] - GRID - shift).norm(dim=-1)[stays] for m in (lost, found)]
    assert errors[0].median() > 5 > 0.1 > errors[1].median()
    assert on_grid(found.confidences)[0, ..., 0][stays].median() > 0.6


# Identities


def test_a_backward_edge_that_is_matched_as_well_is_used(monkeypatch: pytest.MonkeyPatch):
    calls = []
    reverse = dense_flow.reverse_flow

    def counted(*arguments: np.ndarray) -> np.ndarray:
        calls.append(1)
        return reverse(*arguments)

    monkeypatch.setattr(dense_flow, "reverse_flow", counted)
    images = [shifted(d, 0, SIZE) for d in (0, 2, 4)]
    both = flow_of(images).match([0, 1], [1, 0], still(2))
    assert not calls
    alone = flow_of(images).match([0, 2], [1, 1], still(2))
    assert len(calls) == 2
    assert torch.equal(both.targets[0], alone.targets[0])
    assert (both.confidences[0] - alone.confidences[0]).abs().mean() < 0.05


@pytest.mark.parametrize("other", [2, 4])
def test_the_number_of_threads_changes_nothing(other: int, monkeypatch: pytest.MonkeyPatch):
    images = [shifted(3 * d, -d, SIZE) for d in range(4)]
    sources, targets = [0, 1, 1, 2, 3, 0], [1, 0, 2, 3, 2, 3]
    monkeypatch.setattr(threads, "_POOL", ThreadPoolExecutor(1))
    one = flow_of(images).match(sources, targets, still(6))
    monkeypatch.setattr(threads, "_POOL", ThreadPoolExecutor(other))
    many = flow_of(images).match(sources, targets, still(6))
    assert torch.equal(one.targets, many.targets)
    assert torch.equal(one.confidences, many.confidences)
    assert torch.equal(one.matched_ratios, many.matched_ratios)


def test_edges_are_measured_alike_one_by_one_and_all_at_once():
    images = [shifted(3 * d, -d, SIZE) for d in range(4)]
    sources, targets = [0, 1, 2, 0], [1, 2, 3, 3]
    whole = flow_of(images).match(sources, targets, still(4))
    for edge, (source, target) in enumerate(zip(sources, targets, strict=True)):
        alone = flow_of(images).match([source], [target], still())
        assert torch.equal(alone.targets[0], whole.targets[edge])
        assert torch.equal(alone.confidences[0], whole.confidences[edge])
    # One confidence counts for u and v, and is stored once.
    assert whole.confidences.untyped_storage().nbytes() == 4 * whole.confidences[:, 0].numel()


def test_matches_follow_the_order_of_the_edges():
    flow = flow_of([shifted(3 * d, 0, SIZE) for d in range(3)])
    matches = flow.match([0, 2, 0], [1, 1, 2], still(3))
    typical = (on_grid(matches.targets) - GRID)[..., 0].flatten(1).median(1).values
    torch.testing.assert_close(typical, torch.tensor([3.0, -3.0, 6.0]), rtol=0, atol=0.1)


# The chain


def test_a_chain_follows_a_displacement_that_is_too_long_for_one_search():
    chain = flow_of([]).start_chain(shifted(0, 0, SIZE))
    for frame in range(1, 7):
        chain, matches = chain.advance(shifted(8.0 * frame, -3.0 * frame, SIZE))
    shift = torch.tensor([48.0, -18.0])
    stays = (GRID[..., 0] + 48 < WIDTH - 8) & (GRID[..., 1] - 18 > 8)
    error = (on_grid(matches.targets)[0] - GRID - shift).norm(dim=-1)[stays]
    assert error.median() < 0.1
    assert on_grid(matches.confidences)[0, ..., 0][stays].median() > 0.6
    single = composed_flow(
        grayscale(shifted(0, 0, SIZE)), grayscale(shifted(48, -18, SIZE)), constant(0, 0)
    )
    error_of_one = np.linalg.norm(single[::8, ::8] - [48, -18], axis=-1)[stays.numpy()]
    assert np.median(error_of_one) > 5


def test_a_chain_is_not_changed_by_its_next_frame():
    first, _ = flow_of([]).start_chain(shifted(0, 0, SIZE)).advance(shifted(4, 0, SIZE))
    _, once = first.advance(shifted(8, 0, SIZE))
    first.advance(torch.zeros(*SIZE, 3))
    _, again = first.advance(shifted(8, 0, SIZE))
    assert torch.equal(once.targets, again.targets)


def test_a_restarted_chain_measures_from_the_newest_frame():
    chain, _ = flow_of([]).start_chain(shifted(0, 0, SIZE)).advance(shifted(9, 0, SIZE))
    _, matches = chain.restart().advance(shifted(15, 2, SIZE))
    sure = on_grid(matches.confidences)[0, ..., 0] > 0.5
    error = (on_grid(matches.targets)[0] - GRID - torch.tensor([6.0, 2.0])).norm(dim=-1)
    assert sure.float().mean() > 0.6 and error[sure].median() < 0.1


def test_a_chain_expects_the_motion_to_go_on():
    # Each step is 10 px longer than the last: too long from where the last one ended.
    chain = flow_of([]).start_chain(shifted(0, 0, SIZE))
    for place in (10, 30, 60):
        chain, matches = chain.advance(shifted(place, 0, SIZE))
    stays = GRID[..., 0] + 60 < WIDTH - 8
    error = (on_grid(matches.targets)[0] - GRID - torch.tensor([60.0, 0.0])).norm(dim=-1)[stays]
    assert error.median() < 0.1


def test_a_chain_takes_up_a_motion_that_stops():
    chain = flow_of([]).start_chain(shifted(0, 0, SIZE))
    for place in (12, 24, 24):
        chain, matches = chain.advance(shifted(place, 0, SIZE))
    stays = GRID[..., 0] + 24 < WIDTH - 8
    error = (on_grid(matches.targets)[0] - GRID - torch.tensor([24.0, 0.0])).norm(dim=-1)[stays]
    assert error.median() < 0.1


def test_a_wrong_expectation_that_looks_less_different_is_not_followed():
    # Flat grey differs less from a texture than the texture does from itself, moved a little. A
    # start that was chosen for its small difference would point at the grey, and stay there.
    first, second = shifted(0, 0, SIZE), shifted(6, 0, SIZE).clone()
    second[:, :4] = 0.5
    into_the_grey = constant(-WIDTH, 0)
    assert (second[:, :1] - first).abs().mean() < (second - first).abs().mean()
    gray = grayscale(first)
    chain = ClassicalChain(gray, gray, constant(0, 0), into_the_grey)
    _, matches = chain.advance(second)
    error = (on_grid(matches.targets)[0] - GRID - torch.tensor([6.0, 0.0])).norm(dim=-1)
    assert error.median() < 0.1


@pytest.mark.parametrize("steps", [1, 6])
def test_a_jump_that_no_expectation_reaches_is_found_by_corners(steps: int):
    size, shift = (192, 256), torch.tensor([12.0 * steps - 65.0, 24.0])
    chain = flow_of([]).start_chain(shifted(0, 0, size))
    for step in range(steps):
        chain, _ = chain.advance(shifted(12 * (step + 1), 0, size))
    _, matches = chain.advance(shifted(*shift.tolist(), size))
    cells = torch.from_numpy(pixel_positions(size)[::8, ::8])
    ends = cells + shift
    stays = (ends > 8).all(-1) & (ends[..., 0] < 248) & (ends[..., 1] < 184)
    error = (on_grid(matches.targets, cells.shape)[0] - ends).norm(dim=-1)[stays]
    assert error.median() < 0.1 and (error < 0.5).float().mean() > 0.65


def test_corners_are_asked_only_where_the_chain_is_weak(monkeypatch: pytest.MonkeyPatch):
    asked: list[None] = []
    monkeypatch.setattr(dense_flow, "plane_flow", lambda a, b: asked.append(None) or constant(0, 0))
    chain, _ = flow_of([]).start_chain(shifted(0, 0, SIZE)).advance(shifted(6, -3, SIZE))
    assert asked == []
    chain.advance(torch.full((*SIZE, 3), 0.5))
    assert asked == [None]


# Degenerate input


def test_a_size_that_is_no_multiple_of_the_stride():
    size = (61, 83)
    flow = flow_of([shifted(0, 0, size), shifted(2, 1, size)])
    grid = Camera(80, 80, 41, 30, 83, 61).pixel_grid(STRIDE)
    matches = flow.match([0], [1], grid.flatten(0, 1).T[None])
    assert matches.targets.shape == (1, 2, 8 * 11) == matches.confidences.shape
    sure = on_grid(matches.confidences, grid.shape)[0, ..., 0] > 0.5
    error = (on_grid(matches.targets, grid.shape)[0] - grid - torch.tensor([2.0, 1.0])).norm(dim=-1)
    assert error[sure].median() < 0.1


def test_a_prediction_far_outside_the_image_is_survived():
    matches = flow_of([shifted(0, 0, SIZE), shifted(2, 0, SIZE)]).match([0], [1], still() + 1e4)
    assert torch.isfinite(matches.targets).all() and (matches.confidences == 0).all()


def test_the_images_are_not_changed():
    image = shifted(0, 0, SIZE).clone()
    copy = image.clone()
    flow = flow_of([image, image])
    predicted = still()
    flow.match([0], [1], predicted)
    assert torch.equal(image, copy) and torch.equal(predicted, still())


# Errors


def test_a_forgotten_keyframe_cannot_be_matched():
    flow = flow_of([shifted(0, 0, SIZE), shifted(1, 0, SIZE)])
    flow.remove_frame(1)
    with pytest.raises(KeyError):
        flow.match([0], [1], still())
    flow.add_frame(1, shifted(2, 0, SIZE))
    moved = (flow.match([0], [1], still()).targets - still())[:, 0].median()
    assert float(moved) == pytest.approx(2, abs=0.1)


def test_what_was_read_of_old_flow_is_released_after_every_match(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(memory, "SMALLEST", 1)
    released: list[None] = []
    flow = flow_of([shifted(0, 0, SIZE), shifted(2, 0, SIZE)])
    flow.match([0, 1], [1, 0], still(2))
    monkeypatch.setattr("minislam.priors.flow.release", lambda: released.append(None))
    flow.match([0, 1], [1, 0], still(2))  # nothing is measured anew
    assert len(released) == 1
    places = [part.ctypes.data for part in flow._measured[0, 1]]
    assert all(SHELF.holds(torch.from_numpy(part)) for part in flow._measured[0, 1])
    assert places == sorted(places) and places[2] - places[0] < 4 * 5 * flow._measured[0, 1][2].size
