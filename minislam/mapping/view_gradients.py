"""What one keyframe adds to an optimisation step. Any process can compute it."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from minislam.geometry import Camera
from minislam.mapping.config import MappingConfig
from minislam.mapping.density import screen_gradients
from minislam.mapping.losses import render_loss
from minislam.mapping.views import Comparison, View, keyframe_rendering_error
from minislam.splatting import GaussianMap, render
from minislam.uncertainty import RenderingError


@dataclass(frozen=True)
class ViewGradients:
    """What a step needs of one keyframe."""

    by_parameter: dict[str, Tensor]  # dL_render/d(parameter), by its name in the map
    screen: Tensor  # (2, N) `screen_gradients`
    losses: list[float]  # L_render, and its colour
    error: RenderingError | None  # that the MLP learns from


def view_gradients(
    gaussians: GaussianMap,
    camera: Camera,
    T_camera_world: Tensor,  # (4, 4)
    background: Tensor,  # (3,) RGB
    view: View,  # of the keyframe, at the size of the camera
    weight: Tensor,  # (H, W) static weight
    median_depth: float,  # world units, of the scene
    config: MappingConfig,
    comparison: Comparison | None,  # None: the MLP is not trained
) -> ViewGradients:
    """Render a keyframe; return the gradients of L_render, Eq. (6), and the error for the MLP."""
    inputs = {name: p.detach().requires_grad_() for name, p in gaussians.parameters.items()}
    gaussians = replace(gaussians, **inputs)
    offsets = torch.zeros_like(gaussians.means[:, :2], requires_grad=True)
    rendering = render(gaussians, camera, T_camera_world, background, screen_offsets=offsets)
    if view.exposure is not None:  # as the camera shows it, at most white
        rendering = rendering._replace(color=(rendering.color * view.exposure).clamp_max(1))
    reference = view.image, view.depth, weight, median_depth, config
    loss = render_loss(gaussians, rendering, *reference)
    *gradients, by_pixel = torch.autograd.grad(loss.total, [*inputs.values(), offsets])
    by_parameter = dict(zip(inputs, gradients, strict=True))
    screen = screen_gradients(by_pixel, rendering.weight_sums, camera)
    parts = torch.stack([loss.total, loss.color])  # one transfer
    error = keyframe_rendering_error(rendering, comparison) if comparison else None
    return ViewGradients(by_parameter, screen, parts.tolist(), error)
