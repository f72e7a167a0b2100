"""Train the MLP on the rendering error of the map: L_uncer and its optimiser."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from minislam.images import resample
from minislam.state.stateful import FrameOf, Stateful, Tree, to_tree
from minislam.uncertainty import losses
from minislam.uncertainty.config import UncertaintyConfig
from minislam.uncertainty.mlp import UncertaintyMLP

DECAYS, EPSILON = (0.9, 0.999), 1e-8  # of Adam: of its moments; added to the denominator


@dataclass(frozen=True)
class RenderingError:
    """Difference between an image and its rendering on the feature grid, without gradient."""

    ssim: Tensor  # (h', w') L'_SSIM after the median filter, or (n, h', w') of n images
    depth: Tensor  # the same shape, L_depth in depth units, capped
    opacity: Tensor  # the same shape, in [0, 1]

    def total(self, lambda_depth: float) -> Tensor:
        """Return the numerator of L_uncer, L'_SSIM + lambda_1 L_depth, of each cell. Eq. (4)."""
        return self.ssim + lambda_depth * self.depth

    @classmethod
    def stacked(cls, errors: Iterable["RenderingError"]) -> "RenderingError":
        """Return the errors of n images as one."""
        fields = zip(*(vars(error).values() for error in errors), strict=True)
        return cls(*map(torch.stack, fields))


@torch.no_grad()
def rendering_error(
    image: Tensor,  # (H, W, 3) RGB in [0, 1]
    reference_depth: Tensor,  # (H, W) world units, 0 where unknown
    rendered_color: Tensor,  # (H, W, 3)
    rendered_depth: Tensor,  # (H, W) world units
    opacity: Tensor,  # (H, W) in [0, 1]
    grid_shape: tuple[int, int],  # (h', w') cells
    depth_unit: float,  # world units that count as 1 in L_depth
    config: UncertaintyConfig,
) -> RenderingError:
    """Compare a rendering with its image and resample the errors to the feature grid."""
    ssim = losses.modified_ssim_loss(image, rendered_color, opacity, config)
    ssim = losses.median_filter(resample(ssim, *grid_shape), config.median_size)

    # Without any reference depth the median is nan, and every pixel is masked anyway.
    limit = losses.FAR_FACTOR * float(reference_depth[reference_depth > 0].median())
    depth = losses.depth_loss(rendered_depth, reference_depth, limit) / depth_unit
    depth = resample(depth.clamp_max(config.loss_cap), *grid_shape)
    return RenderingError(ssim, depth, resample(opacity, *grid_shape))


def uncertainty_loss(
    beta_raw: Tensor,  # (h', w') of a view, or (n, h', w') of n, with gradient to the MLP
    error: RenderingError,
    sample_beta_raw: Tensor,  # (m,) of cells drawn from the views and their neighbours
    sample_features: Tensor,  # (m, C) of the same cells
    config: UncertaintyConfig,
) -> Tensor:  # ()
    """Return L_uncer: the mean cell loss plus lambda_2 L_reg_V. Eq. (4)."""
    numerator = error.total(config.lambda_depth)
    cells = losses.cell_loss(beta_raw, numerator, error.opacity, config)
    regulariser = losses.variance_regulariser(sample_beta_raw, sample_features, config)
    return cells.mean() + config.lambda_variance * regulariser


class UncertaintyTrainer(Stateful):
    """Hold the MLP, its Adam and its random source for a whole run."""

    generator: torch.Generator
    _first: list[Tensor]  # moments of Adam, by parameter
    _second: list[Tensor]
    _steps: int = 0

    def __init__(
        self,
        feature_dimension: int,  # C
        config: UncertaintyConfig,
        seed: int,
        device: str = "cpu",  # of the MLP; its random numbers are drawn on the CPU
    ) -> None:
        self.config = config
        self.generator = torch.Generator().manual_seed(seed)
        mlp = UncertaintyMLP(feature_dimension, self.generator, config.hidden_units, config.dropout)
        self.mlp = mlp.to(device)
        self._first = [torch.zeros_like(w) for w in mlp.parameters()]
        self._second = [torch.zeros_like(w) for w in mlp.parameters()]

    def saved_state(self) -> Tree:
        """Return the state: weights, Adam's moments and the random source."""
        return {**super().saved_state(), "mlp": to_tree(self.mlp.state_dict())}

    def restore_state(self, state: Tree, frame_of: FrameOf) -> None:
        super().restore_state(state, frame_of)
        self.mlp.load_state_dict(state["mlp"])

    @torch.no_grad()
    def predict(self, features: Tensor) -> Tensor:
        """Return the raw beta (h', w') of features (h', w', C), without dropout or gradient."""
        return self.mlp(features)

    def step(
        self,
        features: Tensor,  # (h', w', C) of the sampled image, or (n, h', w', C) of several
        error: RenderingError,
        nearby_features: Tensor,  # (m, C) cells of it and of its neighbours in time
    ) -> float:
        """Take one Adam step, n times as long, on the mean L_uncer of n images; return it."""
        drawn = torch.randperm(len(nearby_features), generator=self.generator)
        sample = nearby_features[drawn[: self.config.variance_samples].to(nearby_features.device)]
        beta, of_sample = self.mlp(features, self.generator), self.mlp(sample, self.generator)
        loss = uncertainty_loss(beta, error, of_sample, sample, self.config)
        gradients = torch.autograd.grad(loss, list(self.mlp.parameters()))
        self._descend(gradients, self.config.learning_rate * features.shape[:-3].numel())
        return float(loss.detach())

    @torch.no_grad()
    def _descend(self, gradients: tuple[Tensor, ...], rate: float) -> None:
        """Take a step of Adam. Not torch.optim.Adam: that loads torch's compiler, 72 MB."""
        self._steps += 1
        rate, norm = rate / (1 - DECAYS[0] ** self._steps), math.sqrt(1 - DECAYS[1] ** self._steps)
        rows = zip(self.mlp.parameters(), gradients, self._first, self._second, strict=True)
        for weight, gradient, first, second in rows:
            gradient = gradient + self.config.weight_decay * weight
            first.lerp_(gradient, 1 - DECAYS[0])
            second.mul_(DECAYS[1]).addcmul_(gradient, gradient, value=1 - DECAYS[1])
            weight.addcdiv_(first, (second.sqrt() / norm).add_(EPSILON), value=-rate)
