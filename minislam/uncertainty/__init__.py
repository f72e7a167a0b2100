"""Uncertainty (Sec. 3.2): an MLP learns, while the map grows, which image patches move."""

from minislam.uncertainty.config import UncertaintyConfig, paper_uncertainty
from minislam.uncertainty.mlp import UncertaintyMLP
from minislam.uncertainty.snapshots import MlpSnapshots
from minislam.uncertainty.training import RenderingError, UncertaintyTrainer, rendering_error
from minislam.uncertainty.weights import beta_of_mask, mapping_weight, tracking_weight

__all__ = [
    "MlpSnapshots",
    "RenderingError",
    "UncertaintyConfig",
    "UncertaintyMLP",
    "UncertaintyTrainer",
    "beta_of_mask",
    "mapping_weight",
    "paper_uncertainty",
    "rendering_error",
    "tracking_weight",
]
