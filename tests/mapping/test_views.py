"""Keyframes at several sizes, and the depths that are compared with theirs."""

from dataclasses import replace

import pytest
import torch

from minislam.errors import InputError
from minislam.mapping.views import MOST_DEPTHS, median_depth, view_of
from tests.mapping.plane_scene import CAMERA, wall_keyframe

HALF = CAMERA.resized(16, 12)

# Known answers


def test_a_half_size_image_has_half_the_pixels_and_the_same_means():
    view = view_of(wall_keyframe(0), HALF)
    assert view.image.shape == (12, 16, 3) and view.depth.shape == (12, 16)
    torch.testing.assert_close(view.image[0, 0], wall_keyframe(0).image[:2, :2].mean((0, 1)))


def test_shrinking_depth_averages_known_pixels_only():
    keyframe = wall_keyframe(0)
    keyframe.depth[0, 0] = 0
    keyframe.depth[:2, 2:4] = 0
    depth = view_of(keyframe, HALF).depth
    assert float(depth[0, 0]) == pytest.approx(2.0) and depth[0, 1] == 0


# Identities


def test_the_full_size_is_the_keyframe_itself():
    keyframe = wall_keyframe(0)
    keyframe = replace(keyframe, pixels=(255 * keyframe.image).round().byte())
    view = view_of(keyframe, CAMERA)
    assert torch.equal(view.image, keyframe.pixels.float() / 255) and view.depth is keyframe.depth


def test_a_view_has_the_exposure_of_its_keyframe():
    keyframe = replace(wall_keyframe(0), exposure=torch.ones(3))
    for camera in (CAMERA, HALF):
        assert view_of(wall_keyframe(0), camera).exposure is None
        assert view_of(keyframe, camera).exposure is keyframe.exposure


# Errors


def test_keyframes_without_any_depth_are_refused_in_one_sentence():
    record = wall_keyframe(0)
    record.depth.zero_()
    with pytest.raises(InputError, match="some known depth"):
        median_depth([record])


def test_of_many_keyframes_some_tell_the_median_depth():
    record = wall_keyframe(0)
    depths = [torch.full_like(record.depth, 1.0 + number) for number in range(2 * MOST_DEPTHS)]
    keyframes = [replace(record, depth=depth) for depth in depths]
    assert median_depth(keyframes[:5]) == 3
    assert median_depth(keyframes) == pytest.approx(MOST_DEPTHS, abs=1)  # every second one
