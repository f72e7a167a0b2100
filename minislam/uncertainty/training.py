"""Train the MLP on the rendering error of the map: L_uncer and its optimiser."""

from dataclasses import dataclass

import torch
from torch import Tensor

from minislam.images import resample
from minislam.state.stateful import FrameOf, Stateful, Tree, to_tree
from minislam.uncertainty.config import UncertaintyConfig
from minislam.uncertainty.losses import (
    FAR_FACTOR,
    cell_loss,
    depth_loss,
    median_filter,
    modified_ssim_loss,
    variance_regulariser,
)
from minislam.uncertainty.mlp import UncertaintyMLP


@dataclass(frozen=True)
class RenderingError:
    """Difference between a keyframe and its rendering on the feature grid, without gradient."""

    ssim: Tensor  # (h', w') L'_SSIM after the median filter, or (n, h', w') of n keyframes
    depth: Tensor  # the same shape, L_depth in depth units, capped
    opacity: Tensor  # the same shape, in [0, 1]


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
    """Compare a rendering with its keyframe and resample the errors to the feature grid."""
    ssim = modified_ssim_loss(image, rendered_color, opacity, config)
    ssim = median_filter(resample(ssim, *grid_shape), config.median_size)

    known = reference_depth > 0
    # Without any reference depth there is no median, and every pixel is masked anyway.
    median = float(reference_depth[known].median()) if known.any() else 1.0
    depth = depth_loss(rendered_depth, reference_depth, FAR_FACTOR * median) / depth_unit
    depth = resample(depth.clamp_max(config.loss_cap), *grid_shape)
    return RenderingError(ssim, depth, resample(opacity, *grid_shape))


def uncertainty_loss(
    beta_raw: Tensor,  # (h', w') of the view or (n, h', w'), with gradient to the MLP
    error: RenderingError,
    sample_beta_raw: Tensor,  # (n,) of cells drawn from the view and its neighbours
    sample_features: Tensor,  # (n, C) of the same cells
    config: UncertaintyConfig,
) -> Tensor:  # ()
    """Return L_uncer: the mean cell loss plus lambda_2 L_reg_V. Eq. (4)."""
    numerator = error.ssim + config.lambda_depth * error.depth
    cells = cell_loss(beta_raw, numerator, error.opacity, config)
    regulariser = variance_regulariser(sample_beta_raw, sample_features, config)
    return cells.mean() + config.lambda_variance * regulariser


class UncertaintyTrainer(Stateful):
    """Hold the MLP, its Adam and its random source for a whole run."""

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
        self.optimizer = torch.optim.Adam(
            self.mlp.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
        )

    def saved_state(self) -> Tree:
        """Return the state: weights, Adam's moments and the random source."""
        return to_tree(
            {
                "mlp": self.mlp.state_dict(),
                "adam": self.optimizer.state_dict()["state"],
                "generator": self.generator,
            }
        )

    def restore_state(self, state: Tree, frame_of: FrameOf) -> None:
        """Go on from a saved state."""
        self.mlp.load_state_dict(state["mlp"])
        moments = {int(number): moment for number, moment in state["adam"].items()}
        self.optimizer.load_state_dict(self.optimizer.state_dict() | {"state": moments})
        self.generator.set_state(state["generator"])

    @torch.no_grad()
    def predict(self, features: Tensor) -> Tensor:
        """Return the raw beta (h', w') of features (h', w', C), without dropout or gradient."""
        return self.mlp(features)

    def step(
        self,
        features: Tensor,  # (h', w', C) of the sampled keyframe, or (n, h', w', C) of several
        error: RenderingError,
        nearby_features: Tensor,  # (m, C) cells of it and of its neighbours in time
    ) -> float:
        """Take one Adam step on the mean L_uncer, n times as long, and return its value."""
        rate = self.config.learning_rate * features.shape[:-3].numel()
        self.optimizer.param_groups[0]["lr"] = rate
        drawn = torch.randperm(len(nearby_features), generator=self.generator)
        sample = nearby_features[drawn[: self.config.variance_samples].to(nearby_features.device)]
        beta, of_sample = self.mlp(features, self.generator), self.mlp(sample, self.generator)
        loss = uncertainty_loss(beta, error, of_sample, sample, self.config)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.optimizer.step()
        return float(loss.detach())
