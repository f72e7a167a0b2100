"""The map: one row per Gaussian in six tensors, and an Adam whose moments follow the rows."""

from dataclasses import dataclass

import torch
from torch import Tensor

from minislam.errors import require
from minislam.state.stateful import FrameOf, Stateful, Tree

ROWS = [(3,), (4,), (3,), (), (3,), ()]  # shape of a Gaussian's row in each tensor of a map


@dataclass(frozen=True)
class GaussianMap:
    """Raw parameters, the values that the optimiser moves and that a PLY file stores."""

    means: Tensor  # (N, 3) world units
    quats_wxyz: Tensor  # (N, 4) any length but zero; the rotation is that of q / |q|
    log_scales: Tensor  # (N, 3) log of the standard deviation in world units
    opacity_logits: Tensor  # (N,) logit of the opacity
    colors: Tensor  # (N, 3) RGB as in the images, not passed through a function
    anchor_keyframe: Tensor  # (N,) int64, position in the map of the image that inserted it

    def __post_init__(self) -> None:
        count = len(self.means)
        for (name, tensor), row in zip(vars(self).items(), ROWS, strict=True):
            wanted = f"{name} of shape {(count, *row)} in a map of {count} Gaussians"
            found = f"{tuple(tensor.shape)}; give one row per Gaussian in every tensor"
            require(tensor.shape == (count, *row), wanted, found)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def scales(self) -> Tensor:
        """Return the standard deviations (N, 3) in world units."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """Return the opacities (N,) in (0, 1)."""
        return self.opacity_logits.sigmoid()

    @property
    def parameters(self) -> dict[str, Tensor]:
        """Return the tensors that are optimised, by name: all but `anchor_keyframe`."""
        return {name: t for name, t in vars(self).items() if name != "anchor_keyframe"}

    @classmethod
    def empty(cls, device: torch.device | str = "cpu") -> "GaussianMap":
        """Return a map of no Gaussians."""
        tensors = [torch.zeros(0, *row, dtype=torch.float32, device=device) for row in ROWS]
        return cls(*[*tensors[:-1], tensors[-1].long()])

    def concatenate(self, other: "GaussianMap") -> "GaussianMap":
        """Return the map of both: the rows of `other` come last."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return GaussianMap(*map(torch.cat, pairs))

    def keep(self, rows: Tensor) -> "GaussianMap":
        """Return the map of the rows where `rows` (N,) bool is True, in the same order."""
        assert rows.dtype == torch.bool and rows.shape == (len(self),), (rows.dtype, rows.shape)
        return GaussianMap(*(tensor[rows] for tensor in vars(self).values()))

    def detach(self) -> "GaussianMap":
        """Return the same values cut from any graph."""
        return GaussianMap(*(tensor.detach() for tensor in vars(self).values()))


@dataclass(frozen=True)
class LearningRates:
    """Adam's step per parameter group. Source: official WildGS-SLAM."""

    means: float = 9.6e-4  # world units, its factor 6 included
    quats_wxyz: float = 1e-3
    log_scales: float = 6e-3  # its factor 6 included
    opacity_logits: float = 5e-2
    colors: float = 7.05e-4  # of c = 0.28209 f + 0.5, official 2.5e-3 of f


class MapOptimizer(Stateful):
    """Adam over the rows of a map; moments and step counts are kept per Gaussian.

    With one count for all rows, as torch.optim.Adam has, its bias correction would make the first
    step of a late row (1 - decay1) / sqrt(1 - decay2) = 3.2 times too long.
    """

    gaussians: GaussianMap
    _first: dict[str, Tensor]  # first moments, by parameter
    _second: dict[str, Tensor]  # second moments, by parameter
    _steps: Tensor  # (N,)

    DECAYS = (0.9, 0.999)  # of the first and second moment, Adam's defaults
    EPSILON = 1e-15  # added to the denominator: 3DGS, gradients of a mean over pixels are tiny

    def __init__(self, gaussians: GaussianMap, rates: LearningRates) -> None:
        self.rates = rates
        self._set_rows(gaussians)
        self._first = {name: torch.zeros_like(p) for name, p in gaussians.parameters.items()}
        self._second = {name: torch.zeros_like(p) for name, p in gaussians.parameters.items()}
        self._steps = torch.zeros_like(gaussians.opacity_logits)

    def _set_rows(self, gaussians: GaussianMap) -> None:
        leaves = [t.detach().clone().requires_grad_() for t in gaussians.parameters.values()]
        self.gaussians = GaussianMap(*[*leaves, gaussians.anchor_keyframe])

    def restore_state(self, state: Tree, frame_of: FrameOf) -> None:
        super().restore_state(state, frame_of)
        self._set_rows(self.gaussians)

    @torch.no_grad()
    def step(self) -> None:
        """Move every parameter that has a gradient, then drop the gradients."""
        decay1, decay2 = self.DECAYS
        self._steps += 1
        correction1 = 1 - decay1**self._steps  # (N,)
        correction2 = (1 - decay2**self._steps).sqrt()
        for name, values in self.gaussians.parameters.items():
            if values.grad is None:
                continue
            first, second = self._first[name], self._second[name]
            first.lerp_(values.grad, 1 - decay1)
            second.mul_(decay2).addcmul_(values.grad, values.grad, value=1 - decay2)
            rows = (-1,) + (1,) * (values.dim() - 1)
            denominator = (second.sqrt() / correction2.view(rows)).add_(self.EPSILON)
            rate = getattr(self.rates, name) / correction1.view(rows)
            values.sub_(rate * first / denominator)
            values.grad = None

    def append(self, new: GaussianMap) -> None:
        """Add rows with zero moments; those of the old rows stay."""
        self._set_rows(self.gaussians.concatenate(new))
        for moments in (self._first, self._second):
            for name, rows in new.parameters.items():
                moments[name] = torch.cat([moments[name], torch.zeros_like(rows)])
        self._steps = torch.cat([self._steps, torch.zeros_like(new.opacity_logits)])

    def keep(self, rows: Tensor) -> None:
        """Keep the rows where `rows` (N,) bool is True, with their moments."""
        self._set_rows(self.gaussians.keep(rows))
        for moments in (self._first, self._second):
            moments.update({name: moment[rows] for name, moment in moments.items()})
        self._steps = self._steps[rows]

    def replace(self, gaussians: GaussianMap) -> None:
        """Set new values for the same rows, for instance after a deformation of the map."""
        assert len(gaussians) == len(self.gaussians), (len(gaussians), len(self.gaussians))
        self._set_rows(gaussians)
