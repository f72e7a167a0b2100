"""Exercise of notebook 00."""

from collections.abc import Callable

import torch
from torch import Tensor

from minislam.checks.grading import Case, Verdict, check_function, drawn, normals
from minislam.geometry import Camera
from minislam.uncertainty.weights import MAPPING_CAP, MAPPING_CUT, adjusted_beta, mapping_weight


def check_mapping_weight(student: Callable[[Tensor], Tensor]) -> Verdict:
    """Check beta (h, w) -> the weight of each pixel in the map's loss (h, w)."""
    camera = Camera(5.0, 5.0, 1.0, 0.5, 3, 2)

    def uncapped(beta: Tensor) -> Tensor:
        return 0.5 / adjusted_beta(beta, camera) ** 2

    def cut(weight: Tensor, most: float = MAPPING_CAP) -> Tensor:
        return torch.where(weight < MAPPING_CUT, 0.0, weight.clamp_max(most))

    cases = [
        Case((torch.tensor([[0.2, 0.471, 0.6], [0.7, 0.9, 1.2]]),), "small beta"),
        Case((torch.tensor([[0.5, 1.3, 1.5], [2.0, 3.0, 4.0]]),), "large beta"),
        Case((torch.tensor([[0.0, 0.05, 0.1], [0.5, 0.5, 0.5]]),), "beta below the floor"),
        *drawn(lambda seed: Case((1.2 * normals(seed, 2, 3).abs(),), "any beta")),
    ]
    hints = [
        (lambda b: uncapped(b).clamp_max(5), "Weights below 0.1 must be 0: little adds up."),
        (lambda b: cut(uncapped(b), 1e9), "No weight is above 5, that of a beta of a quarter."),
        (lambda b: uncapped(b).clamp(0.1, 5), "Weights below 0.1 become 0, not 0.1."),
        (lambda beta: cut(0.5 / beta**2), "This is 0.5 / beta^2: beta is adjusted first."),
        (lambda beta: cut(0.5 / beta.clamp_min(0.1) ** 2), "beta is cut, but not adjusted yet."),
        (lambda beta: cut(2 * uncapped(beta)), "It is a half by beta_adj^2: 0.5 is missing."),
        (lambda beta: cut((0.5 * uncapped(beta)).sqrt()), "The adjusted beta must be squared."),
    ]
    return check_function(student, lambda b: mapping_weight(b, camera), cases, 1e-5, hints)
