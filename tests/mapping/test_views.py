"""Keyframes at several sizes, and the depths that are compared with theirs."""

import pytest
import torch

from minislam.errors import InputError
from minislam.mapping.views import MappedKeyframe, median_depth
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


def test_the_full_size_is_the_keyframe_itself():
    keyframe = MappedKeyframe.from_record(wall_keyframe(0))
    assert keyframe.view(CAMERA).image is keyframe.image
    assert keyframe.view(CAMERA) is keyframe.view(CAMERA)


# Errors


def test_keyframes_without_any_depth_are_refused_in_one_sentence():
    record = wall_keyframe(0)
    record.depth.zero_()
    with pytest.raises(InputError, match="some known depth"):
        median_depth([record])
