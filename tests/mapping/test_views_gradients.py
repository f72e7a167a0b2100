from dataclasses import replace

import pytest
import torch

from minislam.mapping.losses import render_loss
from minislam.mapping.views import view_gradients, view_of
from minislam.splatting import render
from tests.mapping.plane_scene import CAMERA, make_mapper, wall_keyframe

# Identities


@pytest.mark.parametrize("exposure", [None, torch.tensor([0.5, 1.0, 1.6])])
def test_the_gradients_are_those_of_the_loss_of_one_keyframe(exposure):
    mapper = make_mapper()
    mapper.initialise([replace(wall_keyframe(0), exposure=exposure)])
    keyframe, gaussians = mapper.images[0], mapper._optimizer.gaussians
    share = view_gradients(*mapper._view_arguments(keyframe, CAMERA, trains=False))
    assert all(parameter.grad is None for parameter in gaussians.parameters.values())

    pose, view = keyframe.T_camera_world.float(), view_of(keyframe, CAMERA)
    rendering = render(gaussians, CAMERA, pose, mapper.background)
    if exposure is not None:
        rendering = rendering._replace(color=(rendering.color * exposure).clamp_max(1))
    weight = mapper.static_weight(mapper.beta_of(keyframe), CAMERA)
    reference = view.image, view.depth, weight, mapper.median_depth, mapper.config
    loss, _ = render_loss(gaussians, rendering, *reference)
    loss.backward()
    for name, parameter in gaussians.parameters.items():
        torch.testing.assert_close(share.by_parameter[name], parameter.grad)
    assert share.losses[0] == float(loss.detach())
    assert share.screen.shape == (2, len(gaussians)) and share.error is None


def test_the_error_for_the_mlp_comes_on_its_grid():
    mapper = make_mapper()
    mapper.initialise([wall_keyframe(0)])
    share = view_gradients(*mapper._view_arguments(mapper.images[0], CAMERA, trains=True))
    assert share.error.ssim.shape == mapper.images[0].features.shape[:2]
    assert not share.error.ssim.requires_grad
