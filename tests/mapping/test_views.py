"""Keyframes at several sizes, and the depths that are compared with theirs."""

from dataclasses import replace

import pytest
import torch

from minislam.errors import InputError
from minislam.mapping.views import MappedKeyframe, median_depth
from minislam.splatting import GaussianMap, render
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
    assert keyframe.pixels is record.pixels and not keyframe._views


def test_a_smaller_size_is_computed_once():
    keyframe = MappedKeyframe.from_record(wall_keyframe(0))
    assert keyframe.view(HALF) is keyframe.view(HALF)


def test_a_rendering_is_shown_as_the_camera_exposed_it():
    record = replace(wall_keyframe(0), exposure=torch.tensor([0.5, 1.0, 4.0]))
    blank = render(GaussianMap.empty(), CAMERA, torch.eye(4), torch.tensor([0.4, 0.4, 0.4]))
    for camera in (CAMERA, HALF):
        shown = MappedKeyframe.from_record(record).view(camera).shown(blank)
        torch.testing.assert_close(shown.color[0, 0], torch.tensor([0.2, 0.4, 1.0]))
        assert shown.depth is blank.depth
    assert MappedKeyframe.from_record(wall_keyframe(0)).view(HALF).shown(blank) is blank


# Errors


def test_keyframes_without_any_depth_are_refused_in_one_sentence():
    record = wall_keyframe(0)
    record.depth.zero_()
    with pytest.raises(InputError, match="some known depth"):
        median_depth([record])
