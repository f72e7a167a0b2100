"""The keyframe store: rows that belong together."""

from copy import deepcopy

import pytest
import torch

from minislam.records import Frame
from minislam.state.memory import SHELF
from minislam.tracking import keyframes
from minislam.tracking.keyframes import KeyframeStore
from tests.tracking.scene import normal, poses_on_an_arc, uniform

CELLS = 12


def filled(count: int) -> KeyframeStore:
    store = KeyframeStore(torch.zeros(CELLS))
    poses = poses_on_an_arc(count, 0)
    for index in range(count):
        frame = Frame(3 * index, 0.1 * index, torch.zeros(6, 8, 3))
        depth = None if index % 2 else torch.full((6, 8), float(index))
        features = normal(index, 2, 2, 5)
        disparities, prior = uniform(index, CELLS).float(), uniform(index + 50, CELLS).float()
        store.append(frame, features, depth, poses[index], disparities, prior)
    return store


def test_an_empty_store_has_no_rows():
    store = KeyframeStore(torch.zeros(CELLS))
    assert len(store) == 0 and store.T_camera_world.shape == (0, 4, 4)
    assert store.disparities.shape == (0, CELLS)


def test_rows_come_back_as_they_were_given():
    store = filled(5)
    assert len(store) == 5
    assert [frame.frame_index for frame in store.frames] == [0, 3, 6, 9, 12]
    torch.testing.assert_close(store.T_camera_world, poses_on_an_arc(5, 0), rtol=0, atol=0)
    for index in range(5):
        assert torch.equal(store.disparities[index], uniform(index, CELLS).float())
        assert torch.equal(store.prior_disparities[index], uniform(index + 50, CELLS).float())
        assert (store.metric_depths[index] is None) == bool(index % 2)


def test_there_is_no_largest_number_of_keyframes():
    store = filled(400)  # the official buffer has 350 places
    assert len(store) == len(store.frames) == len(store.features) == 400
    assert torch.equal(store.disparities[399], uniform(399, CELLS).float())


def test_poses_are_float64_and_cells_float32():
    store = filled(2)
    assert store.T_camera_world.dtype == torch.float64
    assert store.disparities.dtype == store.static_weights.dtype == torch.float32


def test_a_new_keyframe_has_full_weights_and_leaves_the_others_alone():
    store = filled(2)
    store.static_weights[0] = torch.full((CELLS,), 0.25)
    frame = Frame(9, 1.0, torch.zeros(6, 8, 3))
    row = torch.ones(CELLS)
    store.append(frame, normal(0, 2, 2, 5), None, torch.eye(4), row, row)
    assert (store.static_weights[0] == 0.25).all() and (store.static_weights[1:] == 1).all()


def test_the_weight_of_a_cell_is_the_product_of_appearance_and_motion():
    store = filled(2)
    store.static_weights[1] = torch.full((CELLS,), 0.5)
    store.motion_weights[1] = torch.full((CELLS,), 0.25)
    assert (store.cell_weights[0] == 1).all() and (store.cell_weights[1] == 0.125).all()


def test_the_newest_keyframe_can_be_removed():
    store, before = filled(3), filled(3)
    store.remove_newest()
    assert len(store) == 2
    assert torch.equal(store.T_camera_world, before.T_camera_world[:2])
    assert torch.equal(store.disparities, before.disparities[:2])


def test_without_a_prior_the_median_disparity_becomes_one_and_the_view_stays():
    store, before = filled(3), filled(3)
    store.prior_disparities.zero_()
    store.normalise_scale()
    assert float(store.disparities.median()) == pytest.approx(1)
    scale = before.disparities.median()
    torch.testing.assert_close(store.disparities * scale, before.disparities)
    moved = store.T_camera_world[:, :3, 3] / scale
    torch.testing.assert_close(moved, before.T_camera_world[:, :3, 3])


def test_the_first_prior_gives_its_unit_to_keyframes_that_came_without():
    store, before = filled(3), filled(3)
    store.prior_disparities.zero_()
    store.start_from_prior()
    assert torch.equal(store.disparities, before.disparities)  # none is known: nothing changes
    prior = store.prior_disparities[2]
    prior[:6] = 5 * store.disparities[2, :6] * torch.tensor([1, 1, 1, 1.1, 0.9, 1])
    for _ in range(2):  # the second time it is the unit already
        store.start_from_prior()
        expected = 5 * before.disparities
        expected[2, :6] = prior[:6]
        torch.testing.assert_close(store.disparities, expected)
        moved = 5 * store.T_camera_world[:, :3, 3]
        torch.testing.assert_close(moved, before.T_camera_world[:, :3, 3])


def test_a_depth_image_that_knows_nothing_is_no_prior():
    store, cells = KeyframeStore(torch.zeros(CELLS)), torch.ones(CELLS)
    frame, pose = Frame(0, 0.0, torch.zeros(6, 8, 3)), torch.eye(4)
    store.append(frame, torch.zeros(2, 2, 5), torch.zeros(6, 8), pose, cells, torch.zeros(CELLS))
    assert not store.has_prior and filled(1).has_prior


def test_a_later_prior_leaves_the_unit():
    store, before = filled(3), filled(3)
    store.start_from_prior()
    assert torch.equal(store.T_camera_world, before.T_camera_world)
    assert torch.equal(store.disparities[:2], before.disparities[:2])
    assert torch.equal(store.disparities[2], before.prior_disparities[2])


def test_a_prior_gives_its_unit_of_length_where_it_is_known():
    store, before = filled(3), filled(3)
    store.prior_disparities.zero_()
    store.prior_disparities[1, :6] = 5 * store.disparities[1, :6]
    store.normalise_scale()
    torch.testing.assert_close(store.disparities, 5 * before.disparities)
    moved = 5 * store.T_camera_world[:, :3, 3]
    torch.testing.assert_close(moved, before.T_camera_world[:, :3, 3])


def test_images_lie_on_the_shelf_also_of_a_restored_store():
    frame = Frame(0, 0.0, torch.zeros(60, 80, 3, dtype=torch.uint8))
    features, depth, row = normal(0, 10, 10, 20), torch.ones(60, 80), torch.ones(CELLS)
    store, restored = KeyframeStore(row), KeyframeStore(row)
    store.append(frame, features, depth, torch.eye(4), row, row)
    restored.restore_state(deepcopy(store.saved_state()), lambda index: deepcopy(frame))
    for known in (store, restored):
        images = known.frames[0].pixels, known.features[0], known.metric_depths[0]
        assert all(SHELF.holds(image) for image in images)
        assert torch.equal(images[1], normal(0, 10, 10, 20))


def test_freed_memory_is_given_back_with_every_keyframe(monkeypatch: pytest.MonkeyPatch):
    given: list[None] = []
    monkeypatch.setattr(keyframes, "give_back_freed", lambda: given.append(None))
    filled(3)
    assert len(given) == 3


def test_a_prior_of_a_far_scene_gives_its_unit_of_length_too():
    store, before = filled(3), filled(3)
    store.prior_disparities[:] = 0.01 * store.disparities  # all beyond one unit
    store.normalise_scale()
    torch.testing.assert_close(store.disparities, 0.01 * before.disparities)
