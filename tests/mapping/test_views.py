"""Keyframes at several sizes, and the depths that are compared with theirs."""

from dataclasses import replace

import pytest
import torch

from minislam.errors import InputError
from minislam.mapping.views import MOST_DEPTHS, MappedKeyframe, median_depth
from tests.mapping.plane_scene import CAMERA, wall_keyframe

HALF = CAMERA.resized(16, 12)

# Known answers


def test_a_half_size_image_has_half_the_pixels_and_the_same_means():
    view = MappedKeyframe.from_record(wall_keyframe(0)).view(HALF)
    assert view.image.shape == (12, 16, 3) and view.depth.shape == (12, 16)
    torch.testing.assert_close(view.image[0, 0], wall_keyframe(0).image[:2, :2].mean((0, 1)))


def test_shrinking_depth_averages_known_pixels_only():
    record = wall_keyframe(0)
    record.depth[0, 0] = 0
    record.depth[:2, 2:4] = 0
    depth = MappedKeyframe.from_record(record).view(HALF).depth
    assert float(depth[0, 0]) == pytest.approx(2.0) and depth[0, 1] == 0


# Identities


def test_the_full_size_is_the_keyframe_itself_and_is_kept_as_bytes_only():
    record = wall_keyframe(0)
    record = replace(record, pixels=(255 * record.image).round().byte())
    keyframe = MappedKeyframe.from_record(record)
    assert torch.equal(keyframe.view(CAMERA).image, record.pixels.float() / 255)
    assert keyframe.view(CAMERA).depth is keyframe.depth
    assert keyframe.pixels is record.pixels and not keyframe._small


def test_a_smaller_size_is_computed_once():
    keyframe = MappedKeyframe.from_record(wall_keyframe(0))
    assert keyframe.view(HALF).image is keyframe.view(HALF).image


def test_a_view_has_the_newest_exposure():
    keyframe = MappedKeyframe.from_record(wall_keyframe(0))
    for camera in (CAMERA, HALF):
        keyframe.exposure = None
        assert keyframe.view(camera).exposure is None
        keyframe.exposure = torch.ones(3)
        assert keyframe.view(camera).exposure is keyframe.exposure


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
