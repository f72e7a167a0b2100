"""Uncertainty (Sec. 3.2): an MLP learns, while the map grows, which image patches move.

Read the files in this order:

    mlp           beta = P(F): one image feature in, one beta out
    weights       the only place where beta becomes a weight, of tracking or of mapping
    losses        the terms of L_uncer: modified SSIM, L_depth, Eq. (3), and the regularisers
    training      L_uncer itself, Eq. (4), and the Adam that lowers it
    config        the settings
"""

from minislam.uncertainty.config import UncertaintyConfig
from minislam.uncertainty.mlp import UncertaintyMLP
from minislam.uncertainty.training import RenderingError, UncertaintyTrainer, rendering_error
from minislam.uncertainty.weights import beta_of_mask, mapping_weight, tracking_weight

__all__ = [
    "RenderingError", "UncertaintyConfig", "UncertaintyMLP", "UncertaintyTrainer", "beta_of_mask",
    "mapping_weight", "rendering_error", "tracking_weight",
]  # fmt: skip
