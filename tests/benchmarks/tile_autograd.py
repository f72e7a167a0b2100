"""A plain renderer for comparison: a Python loop over 16-px tiles, differentiated by autograd.

It is what a careful first implementation looks like: the per-Gaussian steps of the reference
twin, bounding boxes to find the Gaussians of a tile, Eqs. (1) and (2) in torch per tile.
"""

import torch
from torch import Tensor

from minislam.geometry import Camera, se3_exp, transform_points
from minislam.splatting import GaussianMap
from minislam.splatting.constants import MAX_OPACITY, MIN_ALPHA, NEAR_DEPTH
from minislam.splatting.reference import covariances, project_covariances

SIDE = 16  # px
DEVIATIONS = 3.33  # of the bounding box: beyond it alpha is below MIN_ALPHA


def render_tiles_with_autograd(
    gaussians: GaussianMap, camera: Camera, T_camera_world: Tensor, twist: Tensor
) -> tuple[Tensor, Tensor, Tensor]:  # (H, W, 3), (H, W), (H, W)
    """Return colour, depth and opacity over black."""
    T_camera_world = se3_exp(twist) @ T_camera_world
    points = transform_points(T_camera_world, gaussians.means)
    order = points[:, 2].detach().argsort()
    order = order[points.detach()[order, 2] > NEAR_DEPTH]
    points = points[order]
    means2d = camera.project(points)
    covariances2d = project_covariances(
        covariances(gaussians)[order], points, T_camera_world, camera
    )
    conics = torch.linalg.inv(covariances2d)
    opacities = gaussians.opacities[order].clamp(max=MAX_OPACITY)
    features = torch.cat([gaussians.colors[order], points[:, 2:]], 1)
    with torch.no_grad():
        radii = DEVIATIONS * covariances2d.diagonal(dim1=1, dim2=2).sqrt()
        low, high = means2d - radii, means2d + radii

    pixels = camera.pixel_grid()
    strips, opacity_strips = [], []
    for top in range(0, camera.height, SIDE):
        row, opacity_row = [], []
        for left in range(0, camera.width, SIDE):
            tile = pixels[top : top + SIDE, left : left + SIDE].reshape(-1, 2)
            touches = (high >= tile[0]).all(1) & (low <= tile[-1]).all(1)
            inside = touches.nonzero()[:, 0]
            d = tile - means2d[inside][:, None]  # (n, P, 2)
            a, b, c = conics[inside][:, [0, 0, 1], [0, 1, 1]].T[..., None]
            power = -0.5 * (a * d[..., 0] ** 2 + c * d[..., 1] ** 2) - b * d[..., 0] * d[..., 1]
            alphas = opacities[inside][:, None] * power.exp()
            alphas = torch.where(alphas > MIN_ALPHA, alphas, 0)
            after = (1 - alphas).cumprod(0)
            before = torch.cat([torch.ones_like(alphas[:1]), after])
            shape = (min(SIDE, camera.height - top), min(SIDE, camera.width - left), -1)
            row.append(((alphas * before[:-1]).T @ features[inside]).view(shape))
            opacity_row.append((1 - before[-1]).view(shape))
        strips.append(torch.cat(row, 1))
        opacity_strips.append(torch.cat(opacity_row, 1))
    image, opacity = torch.cat(strips), torch.cat(opacity_strips)
    return image[..., :3], image[..., 3], opacity[..., 0]
