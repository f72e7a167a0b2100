"""The uncertainty MLP P: it predicts one beta from one image feature."""

import itertools
import math

import torch
from torch import Tensor, nn


class UncertaintyMLP(nn.Module):
    """Predict beta = P(F) > 0 from features: C -> 64 -> 64 -> 1, ReLU inside, softplus at the end.

    It is trained from scratch in every sequence. All random numbers come from the generators.
    """

    def __init__(
        self,
        feature_dimension: int,  # C
        generator: torch.Generator,  # draws the first weights
        hidden_units: int = 64,
        dropout: float = 0.2,  # fraction of the hidden units, in training only
    ) -> None:
        super().__init__()
        sizes = [feature_dimension, hidden_units, hidden_units, 1]
        self.dropout = dropout
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for fan_in, fan_out in itertools.pairwise(sizes):
            # He's bound keeps the variance through a ReLU; the bias bound is the usual one.
            weight_bound, bias_bound = math.sqrt(6 / fan_in), math.sqrt(1 / fan_in)
            weight = torch.rand(fan_out, fan_in, generator=generator) * 2 - 1
            bias = torch.rand(fan_out, generator=generator) * 2 - 1
            self.weights.append(nn.Parameter(weight * weight_bound))
            self.biases.append(nn.Parameter(bias * bias_bound))

    def forward(
        self,
        features: Tensor,  # (..., C)
        dropout_generator: torch.Generator | None = None,  # None: inference, nothing is dropped
    ) -> Tensor:  # (...) raw beta > 0
        """Predict the raw beta of each feature vector."""
        hidden = features
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            hidden = torch.relu(nn.functional.linear(hidden, weight, bias))
            if dropout_generator is not None and self.dropout > 0:
                hidden = hidden * self._dropout_mask(hidden, dropout_generator)
        output = nn.functional.linear(hidden, self.weights[-1], self.biases[-1])
        return nn.functional.softplus(output.squeeze(-1))

    def _dropout_mask(self, hidden: Tensor, generator: torch.Generator) -> Tensor:
        """Return 0 for dropped units and 1 / (1 - p) for the others, so that the mean stays."""
        # A byte for each unit, because bytes are drawn faster than floats: p is rounded to n / 256.
        dropped, words = round(256 * self.dropout), (-(-hidden.numel() // 8),)  # of 8 bytes
        # Drawn on the generator's device, so that every device drops the same units.
        device, ends = generator.device, (-(2**63), 2**63 - 1)
        draw = torch.randint(*ends, words, generator=generator, device=device).view(torch.uint8)
        kept = (draw[: hidden.numel()].reshape(hidden.shape) >= dropped).to(hidden)
        return kept * (256 / (256 - dropped))
