"""Images of the map at the size of a rendering, and what one adds to an optimisation step."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from minislam.errors import require
from minislam.geometry import Camera
from minislam.images import shrink_depth, shrink_image
from minislam.mapping.config import MappingConfig
from minislam.mapping.density import screen_gradients
from minislam.mapping.losses import render_loss
from minislam.mapping.safeguards import doubted_error
from minislam.records import MapImage, Pictured
from minislam.splatting import GaussianMap, Rendering, render
from minislam.uncertainty import RenderingError, UncertaintyConfig, rendering_error

MOST_DEPTHS = 100  # images whose depths are sorted together: those of 500 fill 300 MB


@dataclass(frozen=True)
class View(Pictured):
    """What a rendering is compared with: an image at one size."""

    pixels: Tensor  # (h, w, 3) uint8 RGB, or RGB in [0, 1]
    depth: Tensor  # (h, w) world units, 0 where unknown
    exposure: Tensor | None = None  # (3,) see `Pictured`


def view_of(whole: MapImage | View, camera: Camera) -> View:
    """Return an image at the size of a camera."""
    size = camera.height, camera.width
    return View(shrink_image(whole.image, *size), shrink_depth(whole.depth, *size), whole.exposure)


def median_depth(images: list[MapImage]) -> float:  # world units
    """Return the median of all known depths, of at most MOST_DEPTHS images, evenly spread."""
    sample = images[:: math.ceil(len(images) / MOST_DEPTHS)]
    depths = torch.cat([image.depth[image.depth > 0] for image in sample])
    advice = "move the camera more, past more texture, or give a depth prior"
    require(len(depths) > 0, "some known depth in the keyframes", f"none; {advice}")
    return float(depths.median())


@dataclass(frozen=True)
class Comparison:
    """How the MLP compares an image with its rendering.

    All comparisons of a run use one size, because the windows of the SSIM are in pixels: at another
    image size the same rendering has another error, and beta learns another value.
    """

    camera: Camera  # at whose size they are compared
    grid_shape: tuple[int, int]  # (h', w') cells
    confirmation: Tensor | None  # (h', w') of the image
    depth_unit: float  # world units that count as 1 in L_depth
    config: UncertaintyConfig


@torch.no_grad()
def image_rendering_error(rendering: Rendering, view: View, by: Comparison) -> RenderingError:
    """Compare an image with its rendering of the same size or a larger one."""
    size = view.depth.shape
    depth_and_opacity = torch.stack([rendering.depth, rendering.opacity], -1)
    depth, opacity = shrink_image(depth_and_opacity, *size).unbind(-1)
    color = shrink_image(rendering.color, *size)
    grid = by.grid_shape, by.depth_unit, by.config
    error = rendering_error(view.image, view.depth, color, depth, opacity, *grid)
    return doubted_error(error, by.confirmation)


@dataclass(frozen=True)
class ViewGradients:
    """What a step needs of one image."""

    by_parameter: dict[str, Tensor]  # dL_render/d(parameter), by its name in the map
    screen: Tensor  # (2, N) `screen_gradients`
    losses: list[float]  # L_render, and its colour
    error: RenderingError | None  # that the MLP learns from


def view_gradients(
    gaussians: GaussianMap,
    camera: Camera,
    T_camera_world: Tensor,  # (4, 4)
    background: Tensor,  # (3,) RGB
    whole: View,  # at its full size
    weight: Tensor,  # (H, W) static weight
    median_depth: float,  # world units, of the scene
    config: MappingConfig,
    comparison: Comparison | None,  # None: the MLP is not trained
) -> ViewGradients:
    """Render an image; return the gradients of L_render, Eq. (6), and the error for the MLP."""
    view = view_of(whole, camera)
    inputs = {name: p.detach().requires_grad_() for name, p in gaussians.parameters.items()}
    gaussians = replace(gaussians, **inputs)
    offsets = torch.zeros_like(gaussians.means[:, :2], requires_grad=True)
    rendering = render(gaussians, camera, T_camera_world, background, screen_offsets=offsets)
    if view.exposure is not None:  # as bright as the image, which is at most white
        rendering = rendering._replace(color=(rendering.color * view.exposure).clamp_max(1))
    reference = view.image, view.depth, weight, median_depth, config
    loss, color_loss = render_loss(gaussians, rendering, *reference)
    *gradients, by_pixel = torch.autograd.grad(loss, [*inputs.values(), offsets])
    by_parameter = dict(zip(inputs, gradients, strict=True))
    screen = screen_gradients(by_pixel, rendering.weight_sums, camera)
    losses = torch.stack([loss, color_loss])  # one transfer from a GPU
    error = None
    if comparison is not None:
        compared = view if comparison.camera == camera else view_of(whole, comparison.camera)
        error = image_rendering_error(rendering, compared, comparison)
    return ViewGradients(by_parameter, screen, losses.tolist(), error)
