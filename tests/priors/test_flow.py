"""Classical flow: known displacements, the order of composition, and chains."""

import numpy as np
import pytest
import torch

from minislam.geometry import Camera
from minislam.priors import dense_flow
from minislam.priors import flow as flow_module
from minislam.priors.dense_flow import (
    composed_flow,
    dense_from_grid,
    grayscale,
    pixel_maps,
    residual_flow,
    reverse_flow,
    warp,
)
from minislam.priors.flow import FlowChain
from tests.priors.patterns import (
    CONFIG,
    GRID,
    HEIGHT,
    INNER,
    SIZE,
    WIDTH,
    constant,
    flow_of,
    on_grid,
    shifted,
    still,
    view,
)


def affine(matrix: list[list[float]], offset: list[float]) -> np.ndarray:
    """Return the flow field matrix p + offset (H, W, 2)."""
    pixels = np.stack(pixel_maps(SIZE), -1)
    return (pixels @ np.float32(matrix).T + np.float32(offset)).astype(np.float32)


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


def test_a_prediction_is_composed_with_what_is_left(monkeypatch: pytest.MonkeyPatch):
    # start(p) = A p + a and a given remainder r(p) = B p + b: the flow is r(p) + start(p + r(p)).
    start = affine([[0.02, -0.05], [0.04, 0.03]], [7.0, -3.0])
    remainder = affine([[-0.01, 0.02], [0.03, 0.01]], [-2.0, 1.5])
    monkeypatch.setattr(dense_flow, "residual_flow", lambda source, target: remainder)
    blank = np.zeros(SIZE, np.uint8)
    actual = composed_flow(blank, blank, start)
    A, a = np.array([[0.02, -0.05], [0.04, 0.03]]), np.array([7.0, -3.0])
    moved = np.stack(pixel_maps(SIZE), -1) + remainder
    expected = remainder + moved @ A.T + a
    # cv2.remap interpolates at steps of 1/32 px.
    np.testing.assert_allclose(actual[INNER], expected[INNER], atol=5e-3)
    swapped = start + remainder
    assert np.abs(swapped - expected)[INNER].max() > 0.1


def test_the_target_is_warped_by_the_prediction_before_the_search(monkeypatch: pytest.MonkeyPatch):
    seen = []

    def standing_still(source: np.ndarray, target: np.ndarray) -> np.ndarray:
        seen.append((source, target))
        return np.zeros((*SIZE, 2), np.float32)

    monkeypatch.setattr(dense_flow, "residual_flow", standing_still)
    source, target = (grayscale(shifted(d, 0, SIZE)) for d in (0.0, 12.0))
    actual = composed_flow(source, target, constant(12, 0))
    # A perfect prediction leaves the two images alike, and the flow is the prediction.
    assert np.abs(seen[0][1].astype(int) - seen[0][0])[:, :-14].max() <= 1
    np.testing.assert_array_equal(actual, constant(12, 0))


def test_composition_gives_the_truth_for_real_images():
    angle, centre = 0.06, np.array([WIDTH / 2, HEIGHT / 2])
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    offset = centre - R @ centre + np.array([25.0, 8.0])
    source = grayscale(shifted(0, 0, SIZE))
    target = grayscale(view(R.T, -R.T @ offset, SIZE))
    truth = affine((R - np.eye(2)).tolist(), offset.tolist())
    start = truth + affine([[0.01, 0.02], [-0.03, 0.01]], [3.0, -2.0])
    error = np.linalg.norm(composed_flow(source, target, start) - truth, axis=-1)
    assert np.median(error[20:-30, 20:-45]) < 0.1


# Identities


def test_warping_by_nothing_changes_nothing():
    gray = grayscale(shifted(0, 0, SIZE))
    np.testing.assert_array_equal(warp(gray, constant(0, 0)), gray)


def test_warping_brings_the_target_back():
    source, target = (grayscale(shifted(d, -d, SIZE)) for d in (0.0, 6.0))
    np.testing.assert_array_equal(warp(target, constant(6, -6))[INNER], source[INNER])


def test_grid_targets_become_a_dense_flow():
    flow = affine([[0.02, -0.05], [0.04, 0.03]], [7.0, -3.0])
    stride = CONFIG.stride
    targets = (np.stack(pixel_maps(SIZE), -1) + flow)[::stride, ::stride]
    dense = dense_from_grid(targets, SIZE, stride)
    assert dense.shape == flow.shape
    inside = (slice(0, HEIGHT - stride), slice(0, WIDTH - stride))  # beyond the last cell: held
    np.testing.assert_allclose(dense[inside], flow[inside], atol=1e-2)
    np.testing.assert_allclose(dense[::stride, ::stride], flow[::stride, ::stride], atol=1e-4)


def test_the_reverse_flow_is_the_inverse(monkeypatch: pytest.MonkeyPatch):
    # With nothing left to find, what remains is the inversion of the forward field itself.
    monkeypatch.setattr(
        dense_flow, "residual_flow", lambda *images: np.zeros((*SIZE, 2), np.float32)
    )
    M, m = np.array([[0.03, -0.06], [0.05, 0.02]]), np.array([4.0, -3.0])
    blank = np.zeros(SIZE, np.uint8)
    backward = reverse_flow(blank, blank, affine(M.tolist(), m.tolist()))
    # q = (I + M) p + m, so p - q = (I + M)^-1 (q - m) - q.
    pixels = np.stack(pixel_maps(SIZE), -1)
    expected = (pixels - m) @ np.linalg.inv(np.eye(2) + M).T - pixels
    np.testing.assert_allclose(backward[INNER], expected[INNER], atol=2e-2)


def test_forward_and_reverse_flow_cancel_on_real_images():
    source, target = (grayscale(shifted(d, d / 2, SIZE)) for d in (0.0, 7.0))
    forward = composed_flow(source, target, constant(0, 0))
    backward = reverse_flow(source, target, forward)
    there_and_back = forward + warp(backward, forward)
    assert np.median(np.linalg.norm(there_and_back, axis=-1)[INNER]) < 0.05


def test_a_backward_edge_that_is_matched_as_well_is_used(monkeypatch: pytest.MonkeyPatch):
    calls = []
    reverse = flow_module.reverse_flow

    def counted(*arguments: np.ndarray) -> np.ndarray:
        calls.append(1)
        return reverse(*arguments)

    monkeypatch.setattr(flow_module, "reverse_flow", counted)
    images = [shifted(d, 0, SIZE) for d in (0, 2, 4)]
    both = flow_of(images).match([0, 1], [1, 0], still(2))
    assert not calls
    alone = flow_of(images).match([0, 2], [1, 1], still(2))
    assert len(calls) == 2
    assert torch.equal(both.targets[0], alone.targets[0])
    assert (both.confidences[0] - alone.confidences[0]).abs().mean() < 0.05


@pytest.mark.parametrize("other", [2, 4])
def test_the_number_of_workers_changes_nothing(other: int):
    images = [shifted(3 * d, -d, SIZE) for d in range(4)]
    sources, targets = [0, 1, 1, 2, 3, 0], [1, 0, 2, 3, 2, 3]
    one = flow_of(images, workers=1).match(sources, targets, still(6))
    many = flow_of(images, workers=other).match(sources, targets, still(6))
    assert torch.equal(one.targets, many.targets)
    assert torch.equal(one.confidences, many.confidences)
    assert torch.equal(one.matched_ratios, many.matched_ratios)


def test_matches_follow_the_order_of_the_edges():
    flow = flow_of([shifted(3 * d, 0, SIZE) for d in range(3)])
    matches = flow.match([0, 2, 0], [1, 1, 2], still(3))
    typical = (on_grid(matches.targets) - GRID)[..., 0].flatten(1).median(1).values
    torch.testing.assert_close(typical, torch.tensor([3.0, -3.0, 6.0]), rtol=0, atol=0.1)


# The chain


def test_a_chain_follows_a_displacement_that_is_too_long_for_one_search():
    chain = flow_of([]).start_chain(shifted(0, 0, SIZE))
    for frame in range(1, 7):
        chain, matches = chain.advanced(shifted(8.0 * frame, -3.0 * frame, SIZE))
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
    first, _ = flow_of([]).start_chain(shifted(0, 0, SIZE)).advanced(shifted(4, 0, SIZE))
    _, once = first.advanced(shifted(8, 0, SIZE))
    first.advanced(torch.zeros(*SIZE, 3))
    _, again = first.advanced(shifted(8, 0, SIZE))
    assert torch.equal(once.targets, again.targets)


def test_a_restarted_chain_measures_from_the_newest_frame():
    chain, _ = flow_of([]).start_chain(shifted(0, 0, SIZE)).advanced(shifted(9, 0, SIZE))
    _, matches = chain.restarted().advanced(shifted(15, 2, SIZE))
    sure = on_grid(matches.confidences)[0, ..., 0] > 0.5
    error = (on_grid(matches.targets)[0] - GRID - torch.tensor([6.0, 2.0])).norm(dim=-1)
    assert sure.float().mean() > 0.6 and error[sure].median() < 0.1


def test_a_chain_expects_the_motion_to_go_on():
    # Each step is 10 px longer than the last: too long from where the last one ended.
    chain = flow_of([]).start_chain(shifted(0, 0, SIZE))
    for place in (10, 30, 60):
        chain, matches = chain.advanced(shifted(place, 0, SIZE))
    stays = GRID[..., 0] + 60 < WIDTH - 8
    error = (on_grid(matches.targets)[0] - GRID - torch.tensor([60.0, 0.0])).norm(dim=-1)[stays]
    assert error.median() < 0.1


def test_a_chain_takes_up_a_motion_that_stops():
    chain = flow_of([]).start_chain(shifted(0, 0, SIZE))
    for place in (12, 24, 24):
        chain, matches = chain.advanced(shifted(place, 0, SIZE))
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
    chain = FlowChain(grayscale(first), grayscale(first), constant(0, 0), into_the_grey, CONFIG)
    _, matches = chain.advanced(second)
    error = (on_grid(matches.targets)[0] - GRID - torch.tensor([6.0, 0.0])).norm(dim=-1)
    assert error.median() < 0.1


# Degenerate input


def test_a_size_that_is_no_multiple_of_the_stride():
    size = (61, 83)
    flow = flow_of([shifted(0, 0, size), shifted(2, 1, size)])
    grid = Camera(80, 80, 41, 30, 83, 61).pixel_grid(CONFIG.stride)
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


def test_searching_from_zero_finds_nothing_between_like_images():
    gray = grayscale(shifted(0, 0, SIZE))
    assert np.abs(residual_flow(gray, gray)).max() < 0.05


# Errors


def test_a_forgotten_keyframe_cannot_be_matched():
    flow = flow_of([shifted(0, 0, SIZE), shifted(1, 0, SIZE)])
    flow.remove_frame(1)
    with pytest.raises(KeyError):
        flow.match([0], [1], still())
    flow.add_frame(1, shifted(2, 0, SIZE))
    moved = (flow.match([0], [1], still()).targets - still())[:, 0].median()
    assert float(moved) == pytest.approx(2, abs=0.1)
