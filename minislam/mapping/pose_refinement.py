"""Photometric refinement: move the camera until the map looks like its image (supplement).

The official code lets Adam descend along the pose gradient, 100 renderings per frame. Here the
same gradient is divided by the curvature of the loss, and a few steps suffice. Only the
gradient must be exact, because it defines the minimum; the curvature sets the length of a step.
"""

import math

import torch
from torch import Tensor

from minislam.geometry import Camera, se3_exp
from minislam.mapping.config import PoseRefinementConfig
from minislam.splatting import GaussianMap, Rendering, render
from minislam.uncertainty.losses import SURFACE_OPACITY

# Levenberg-Marquardt: the damping as a fraction of the curvature's diagonal, and its factors after
# a step that failed and after one that succeeded; the start counts as a success.
_FIRST_DAMPING, _MORE_DAMPING, _LESS_DAMPING = 1e-3, 10.0, 0.3
ROUNDING = 0.01  # colour difference below which |r| is rounded off to a parabola, about the noise


def refine_pose(
    gaussians: GaussianMap,  # constant
    camera: Camera,
    start: Tensor,  # T_camera_world (4, 4)
    image: Tensor,  # (H, W, 3) RGB in [0, 1], what the camera saw
    weight: Tensor,  # (H, W) static weight, 0 on dynamic objects
    background: Tensor,  # (3,) RGB
    config: PoseRefinementConfig,
) -> Tensor:  # (4, 4) float64
    """Return the pose near the start from which the rendering error is smallest.

    A step that does not lower the loss is undone and repeated with more damping, so the loss of
    the result is never larger than that of the start.
    """
    pose = candidate = start.double()
    lowest, damping = math.inf, _FIRST_DAMPING
    for steps_done in range(config.iterations + 1):
        twist = torch.zeros(6, dtype=gaussians.means.dtype, device=image.device, requires_grad=True)
        rendering = render(gaussians, camera, candidate, background, twist=twist)
        loss = rerendering_loss(rendering, image, weight)
        improved = float(loss.detach()) < lowest
        if improved:
            pose, lowest, damping = candidate, float(loss.detach()), _LESS_DAMPING * damping
            seen = rendering  # from the pose that a step starts from
        if steps_done == config.iterations or not math.isfinite(lowest):
            break
        if improved:
            (gradient,) = torch.autograd.grad(loss, twist)
            hessian = curvature(rendering, image, weight, camera)
            if not hessian.diagonal().min() > 0:
                break  # The picture does not depend on the pose: it is empty or uniform.
        else:
            damping *= _MORE_DAMPING
        damped = hessian + damping * torch.diag(hessian.diagonal())
        step = -torch.linalg.solve(damped, gradient.double())
        if _motion(step, seen, camera) < config.tolerance:
            break
        candidate = se3_exp(step) @ pose
    return pose


def rerendering_loss(
    rendering: Rendering,
    image: Tensor,  # (H, W, 3) RGB in [0, 1]
    weight: Tensor,  # (H, W) static weight
) -> Tensor:  # ()
    """Return the mean of weight * opacity * |I^ - I|, with |r| as sqrt(r^2 + 0.01^2)."""
    # The opacity is a constant, as in the official code. With its gradient the camera would turn to
    # where the map is empty, because the loss is 0 there.
    absolute = ((rendering.color - image).square() + ROUNDING**2).sqrt().mean(-1)
    return (weight * rendering.opacity.detach() * absolute).mean()


@torch.no_grad()
def curvature(
    rendering: Rendering,
    image: Tensor,  # (H, W, 3)
    weight: Tensor,  # (H, W)
    camera: Camera,
) -> Tensor:  # (6, 6) float64
    """Return the Gauss-Newton matrix of the loss: the mean of w J^T J / |I^ - I|.

    A twist xi moves the point seen at a pixel by A xi px, see `Camera.twist_jacobian`. The colour
    at the pixel changes by -g^T A xi, with the slope g = (dI^/du, dI^/dv) of a channel, so
    J = -g^T A. The channels have A in common, so

        sum_c w J_c^T J_c / |r_c| = A^T G A,        G = sum_c w g_c g_c^T / |r_c|   (2x2).
    """
    solid = rendering.opacity > SURFACE_OPACITY
    absolute = ((rendering.color - image).square() + ROUNDING**2).sqrt()
    factor = (weight * rendering.opacity * solid)[..., None] / absolute / absolute.numel()
    slope_u, slope_v = image_slope(rendering.color)
    weighted_u, weighted_v = factor * slope_u, factor * slope_v
    uu, vv = (weighted_u * slope_u).sum(-1), (weighted_v * slope_v).sum(-1)
    uv = (weighted_u * slope_v).sum(-1)
    depth = torch.where(solid, rendering.depth / rendering.opacity, 1)
    pixels = camera.pixel_grid(dtype=depth.dtype, device=depth.device)
    x, y, _ = camera.rays(pixels.reshape(-1, 2)).unbind(-1)
    u, v = camera.twist_jacobian(x, y, 1 / depth.reshape(-1)).unbind(1)  # (6, H W) each
    uu, uv, vv = uu.reshape(-1), uv.reshape(-1), vv.reshape(-1)
    return (u @ (uu * u + uv * v).T + v @ (uv * u + vv * v).T).double()


def image_slope(image: Tensor) -> Tensor:  # (H, W, 3) -> (2, H, W, 3)
    """Return (d/du, d/dv) per pixel and channel by central differences, 0 at the border."""
    slope = image.new_zeros(2, *image.shape)
    slope[0, :, 1:-1] = (image[:, 2:] - image[:, :-2]) / 2
    slope[1, 1:-1] = (image[2:] - image[:-2]) / 2
    return slope


def _motion(step: Tensor, rendering: Rendering, camera: Camera) -> float:
    """Return about how many pixels a step moves the image of a point at mean depth."""
    depth = float((rendering.depth.sum() / rendering.opacity.sum().clamp_min(1e-12)).detach())
    rho, phi = float(step[:3].norm()), float(step[3:].norm())
    return camera.fx * (phi + rho / max(depth, 1e-12))
