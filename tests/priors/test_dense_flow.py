"""Dense flow: warping, the order of composition, and the reverse flow."""

import numpy as np
import pytest

from minislam.priors import dense_flow
from minislam.priors.dense_flow import (
    composed_flow,
    dense_from_grid,
    grayscale,
    pixel_positions,
    plane_flow,
    residual_flow,
    reverse_flow,
    warp,
)
from minislam.priors.flow import STRIDE
from tests.priors.patterns import HEIGHT, INNER, SIZE, WIDTH, constant, shifted, view


def affine(matrix: list[list[float]], offset: list[float]) -> np.ndarray:
    """Return the flow field matrix p + offset (H, W, 2)."""
    pixels = pixel_positions(SIZE)
    return (pixels @ np.float32(matrix).T + np.float32(offset)).astype(np.float32)


def test_a_prediction_is_composed_with_what_is_left(monkeypatch: pytest.MonkeyPatch):
    # start(p) = A p + a and a given remainder r(p) = B p + b: the flow is r(p) + start(p + r(p)).
    start = affine([[0.02, -0.05], [0.04, 0.03]], [7.0, -3.0])
    remainder = affine([[-0.01, 0.02], [0.03, 0.01]], [-2.0, 1.5])
    monkeypatch.setattr(dense_flow, "residual_flow", lambda source, target: remainder)
    blank = np.zeros(SIZE, np.uint8)
    actual = composed_flow(blank, blank, start)
    A, a = np.array([[0.02, -0.05], [0.04, 0.03]]), np.array([7.0, -3.0])
    moved = pixel_positions(SIZE) + remainder
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
    # A perfect prediction leaves two similar images, and the flow is the prediction.
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


def test_warping_by_nothing_changes_nothing():
    gray = grayscale(shifted(0, 0, SIZE))
    np.testing.assert_array_equal(warp(gray, constant(0, 0)), gray)


def test_warping_brings_the_target_back():
    source, target = (grayscale(shifted(d, -d, SIZE)) for d in (0.0, 6.0))
    np.testing.assert_array_equal(warp(target, constant(6, -6))[INNER], source[INNER])


def test_grid_targets_become_a_dense_flow():
    flow = affine([[0.02, -0.05], [0.04, 0.03]], [7.0, -3.0])
    stride = STRIDE
    targets = (pixel_positions(SIZE) + flow)[::stride, ::stride]
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
    pixels = pixel_positions(SIZE)
    expected = (pixels - m) @ np.linalg.inv(np.eye(2) + M).T - pixels
    np.testing.assert_allclose(backward[INNER], expected[INNER], atol=2e-2)


def test_forward_and_reverse_flow_cancel_on_real_images():
    source, target = (grayscale(shifted(d, d / 2, SIZE)) for d in (0.0, 7.0))
    forward = composed_flow(source, target, constant(0, 0))
    backward = reverse_flow(source, target, forward)
    there_and_back = forward + warp(backward, forward)
    assert np.median(np.linalg.norm(there_and_back, axis=-1)[INNER]) < 0.05


def test_searching_from_zero_finds_nothing_between_equal_images():
    gray = grayscale(shifted(0, 0, SIZE))
    assert np.abs(residual_flow(gray, gray)).max() < 0.05


# The flow of a plane


def test_the_flow_of_a_plane_that_turns_far_is_found_though_a_fifth_moves_otherwise():
    size, angle = (192, 256), np.radians(25)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    offset = np.array([30.0, -20.0])
    first, second = (
        grayscale(view(m, o, size)) for m, o in ((np.eye(2), 0 * offset), (turn, offset))
    )
    second[:76, :128] = grayscale(view(np.eye(2), np.array([9.0, 4.0]), (76, 128)))
    pixels = pixel_positions(size)
    truth = (pixels - offset) @ turn - pixels  # where turn q + offset = p
    found = plane_flow(first, second)
    assert np.linalg.norm(truth, axis=-1).max() > 100
    assert np.linalg.norm(found - truth, axis=-1).max() < 2


@pytest.mark.parametrize("other", ["grey", "noise"])
def test_without_common_corners_nothing_moves(other: str):
    gray, noise = np.full(SIZE, 90, np.uint8), np.random.default_rng(1).integers(0, 256, SIZE)
    there = {"grey": gray, "noise": noise.astype(np.uint8)}[other]
    assert not plane_flow(grayscale(shifted(0, 0, SIZE)), there).any()
    assert not plane_flow(there, grayscale(shifted(0, 0, SIZE))).any()
