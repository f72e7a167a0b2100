"""Against dynamic objects that beta alone leaves in the map. All of this is ours, not the paper's.

Other views confirm what stands still: `stereo/votes.py` gives the confirmation of each patch. And
the distribution of beta over a whole clip shows how large beta is on the dynamic objects there.
"""

from dataclasses import replace

import cv2
import torch
from torch import Tensor

from minislam.geometry import Camera
from minislam.splatting import GaussianMap, render
from minislam.uncertainty import RenderingError, UncertaintyConfig, weights
from minislam.uncertainty.losses import SURFACE_OPACITY

# The rendering error of a confirmed cell fades: where it stands still, the map is wrong. [-]
CONFIRMED_ERROR = 1.5
# Fraction of beta that is taken away where other views confirm. A beta above the cut is kept: what
# it excludes may have stood still for a while. [-]
CONFIRMED_BETA = 0.4
# Renderings of each image before which beta weights nothing: as long as the map is not fitted,
# its errors are not those of dynamic objects, and what is excluded then would never be fitted.
FIRST_VIEWS = 4
LEAST_UPPER_MODE = 0.85  # mean raw beta: a mode with less is what the map does not show yet
UPPER_MODE = 0.75  # of that mean, from which on a raw beta belongs to the mode
BINS = 50  # of the histogram, per unit of raw beta
LEAST_VIEWS = 2  # renderings of each image before which beta of a static room may still be high
# Of the pixels that show a Gaussian, by blending weight, that must be static [-]: 0.01 to 0.1 take
# a carried table out of the map; from 0.05 on, they also take a wall that beta doubts.
LEAST_STATIC = 0.02
LEAST_WRONG = 0.5  # of the cells of the upper mode, else they are kept [-]
ASKED = 24  # most images, evenly spread, whose rendering errors decide that
OPAQUE = 0.5  # opacity: a less opaque pixel shows a gap rather than a surface [-]


def confirmed_beta(beta: Tensor, confirmation: Tensor | None) -> Tensor:
    """Return the raw beta (h', w'), less where other views confirm; one above the cut is kept."""
    if confirmation is None:
        return beta
    lowered = beta * (1 - CONFIRMED_BETA * confirmation.clamp_min(0))
    return torch.where(beta > weights.BETA_CUT, beta, lowered)


def doubted_error(error: RenderingError, confirmation: Tensor | None) -> RenderingError:
    """Return the rendering error that the MLP learns from, less where other views confirm."""
    if confirmation is None:
        return error
    doubt = (1 - CONFIRMED_ERROR * confirmation).clamp(0, 1)
    return replace(error, ssim=doubt * error.ssim, depth=doubt * error.depth)


def least_weight(beta_raw: Tensor) -> float:
    """Return the weight below which a pixel is excluded, 0.1 or more, by all betas (n,) of a clip.

    How large beta is on a dynamic object depends on how unlike its background it looks. Otsu's
    threshold splits the betas into two modes; if the upper one is large, betas from three quarters
    of its mean on are excluded.
    """
    bins = (BINS * beta_raw).clamp_max(255).byte()
    split, _ = cv2.threshold(bins.cpu().numpy(), 0, 255, cv2.THRESH_OTSU)
    upper = beta_raw[bins > split].mean()  # the last bin of the lower mode is `split`
    if not upper > LEAST_UPPER_MODE:  # nan without one
        return weights.MAPPING_CUT
    at_cut = weights.weight_of(weights.clipped_beta(UPPER_MODE * upper))
    return max(weights.MAPPING_CUT, float(at_cut))


def without_acquitted(
    confirmation: Tensor | None,  # (h', w')
    error: RenderingError,
    config: UncertaintyConfig,
) -> Tensor | None:
    """Return the confirmation with 0 where the map shows rightly what other views look through.

    The depth there is wrong, because something moves or because it was mistaken. The map has
    learned the place from other images alone: if it looks the same in this one, nothing moves. A
    hole has no error either: views that truly look through a thing would have filled it.
    """
    if confirmation is None:
        return None
    is_right = optimal_beta(error, config) < weights.UNIT_BETA
    return torch.where((confirmation < 0) & is_right, 0, confirmation)


def optimal_beta(error: RenderingError, config: UncertaintyConfig) -> Tensor:  # (..., h', w')
    """Return the beta with the least `cell_loss` of each cell alone: sqrt(2 L / lambda_3)."""
    return (2 * error.total(config.lambda_depth) / config.lambda_log).sqrt()


def is_wrong(
    error: RenderingError, beta_raw: Tensor, least: float, config: UncertaintyConfig
) -> bool:
    """Tell whether the map is wrong in most cells (..., h', w') below a least weight, or none is.

    The MLP sees features, not places: a dark wall, rendered well, gets the beta of a dark dog in
    front of it.
    """
    optimal = optimal_beta(error, config)
    excluded, wrong = (
        weights.weight_of(weights.clipped_beta(beta)) < least for beta in (beta_raw, optimal)
    )
    excluded &= error.opacity >= SURFACE_OPACITY  # a hole is no error
    return not excluded.any() or float(wrong[excluded].float().mean()) >= LEAST_WRONG


def static_blending(
    gaussians: GaussianMap,
    camera: Camera,
    T_camera_world: Tensor,  # (4, 4)
    weight: Tensor,  # (H, W) static weight
) -> tuple[Tensor, float]:  # (2, N) px, [-]
    """Return the blending weights of the Gaussians in a view, and the fraction that the map shows.

    The weights of each Gaussian are summed over the static pixels, and over all. The fraction is
    that of the static pixels where the map is opaque: without any static pixel 1, or 0 for an empty
    map. The rendered colour is linear in the Gaussians' colours: the weights are its derivative.
    """
    static, colors = weight > 0, gaussians.colors.detach()
    colors.requires_grad_(not static.all())
    rendering = render(replace(gaussians, colors=colors), camera, T_camera_world)
    of_static = rendering.weight_sums
    if colors.requires_grad:
        of_static = torch.autograd.grad(rendering.color[..., 0][static].sum(), colors)[0][:, 0]
    shown = rendering.opacity.detach()[static] > OPAQUE
    fraction = float(shown.float().mean()) if len(shown) else float(len(gaussians) > 0)
    return torch.stack([of_static, rendering.weight_sums]), fraction
