"""The settings of the uncertainty MLP and of its loss."""

from dataclasses import dataclass

from minislam.errors import require
from minislam.parameters import parameter


@dataclass(frozen=True)
class UncertaintyConfig:
    """How beta is predicted and trained. "official" names the constants of the authors' code."""

    enabled: bool = parameter(True, "off: every weight is 1 and nothing is trained (ablation a)")
    given_masks: bool = parameter(
        False, "take the masks of moving objects that the sequence has, train nothing (ablation c)"
    )

    grid_factor: int = parameter(
        1, "the grid of beta is n times as fine, its features cost n^2 times as much; supplement", 1
    )
    hidden_units: int = parameter(64, "width of the two hidden layers [units], official", 1)
    dropout: float = parameter(0.2, "hidden units dropped in training [-], official", most=0.99)
    learning_rate: float = parameter(
        2e-3, "Adam step of the MLP [1]; official 4e-4 for 10^4 iterations, ours 10^3", most=1
    )
    weight_decay: float = parameter(1e-5, "L2 pull on the weights [1]; official on half the loss")

    lambda_depth: float = parameter(
        0.2, "lambda_1: weight of L_depth [1 per depth unit], official; 0 is ablation (b)"
    )
    lambda_variance: float = parameter(
        1.0, "lambda_2: weight of L_reg_V [1], official 0.5 on a loss halved throughout"
    )
    lambda_log: float = parameter(0.5, "lambda_3: weight of L_reg_U = log beta [1], official")

    ssim_gain: float = parameter(
        668.42, "factor of (1-l)(1-s)(1-c) [1]: 100 + 900 b(0.3; 0.8), NeRF On-the-go"
    )
    loss_cap: float = parameter(5.0, "cap of SSIM and depth term [1], official: beta <= 2 sqrt(6)")
    median_size: int = parameter(3, "median window [cells], odd; official 5 on 1,100 cells", 1)

    similarity: float = parameter(0.75, "least cosine of similar features [1], official", most=1)
    neighbours: int = parameter(128, "most similar cells that enter L_reg_V [cells], official", 1)
    variance_samples: int = parameter(
        350, "cells drawn per step for L_reg_V [cells], official: a sixteenth of 5 keyframes", 1
    )
    neighbour_keyframes: int = parameter(2, "images before and after that enter L_reg_V, official")

    @property
    def is_learned(self) -> bool:
        """Tell whether beta comes from the MLP."""
        return self.enabled and not self.given_masks

    @property
    def takes_masks(self) -> bool:
        """Tell whether beta comes from masks that are given."""
        return self.enabled and self.given_masks

    def __post_init__(self) -> None:
        is_right = self.median_size >= 1 and self.median_size % 2 == 1
        found = f"{self.median_size}; set uncertainty.median_size to 1, 3 or 5"
        require(is_right, "an odd median window of at least 1 cell", found)
