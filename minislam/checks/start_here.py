"""Exercise of notebook 00."""

from collections.abc import Callable

import torch
from torch import Tensor

from minislam.checks.grading import Case, Verdict, check_function
from minislam.geometry import Camera
from minislam.uncertainty.weights import WEIGHT_SCALE, adjusted_beta, mapping_weight


def check_mapping_weight(student: Callable[[Tensor], Tensor]) -> Verdict:
    """Check beta (h, w) -> the weight of each pixel in the map's loss (h, w)."""
    camera = Camera(5.0, 5.0, 1.0, 0.5, 3, 2)

    def reference(beta: Tensor) -> Tensor:
        return mapping_weight(beta, camera)

    def uncut(beta: Tensor) -> Tensor:
        return WEIGHT_SCALE / adjusted_beta(beta, camera) ** 2

    cases = [
        Case((torch.tensor([[0.2, 0.471, 0.6], [0.7, 0.9, 1.2]]),), "small beta"),
        Case((torch.tensor([[0.5, 1.3, 1.5], [2.0, 3.0, 4.0]]),), "large beta"),
        Case((torch.tensor([[0.0, 0.05, 0.1], [0.5, 0.5, 0.5]]),), "beta below the floor"),
    ]
    hint = "Weights below 0.1 must be 0: over many iterations a little is too much."
    return check_function(student, reference, cases, tolerance=1e-5, hints=[(uncut, hint)])
