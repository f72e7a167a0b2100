"""The MLP as it was at earlier moments, to show how it learnt what moves."""

from torch import Tensor
from torch.func import functional_call

from minislam.state.stateful import Stateful
from minislam.uncertainty.mlp import UncertaintyMLP

MOST = 32  # copies kept; a copy for DINOv2 features takes 115 kB


class MlpSnapshots(Stateful):
    """Copies of the weights of an MLP, at most 32, spread evenly over the run."""

    _weights: dict[int, dict[str, Tensor]]  # by moment, in order
    _spacing: int = 1  # calls of `record` per copy
    _calls: int = 0

    def __init__(self, mlp: UncertaintyMLP) -> None:
        self._weights = {}
        self._mlp = mlp

    @property
    def moments(self) -> list[int]:
        """Return the moments of the copies, in order."""
        return list(self._weights)

    def record(self, moment: int) -> None:
        """Copy the present weights; in a long run at every second call, every fourth, ..."""
        if self._calls % self._spacing == 0:
            weights = self._mlp.state_dict()
            self._weights[moment] = {name: w.detach().clone() for name, w in weights.items()}
        self._calls += 1
        if len(self._weights) > MOST:
            self._weights = dict(list(self._weights.items())[::2])
            self._spacing *= 2

    def predict(
        self,
        moment: int,
        features: Tensor,  # (h', w', C)
    ) -> Tensor:  # (h', w')
        """Return the raw beta by the newest copy up to a moment, or by the first copy."""
        newest = max((m for m in self._weights if m <= moment), default=self.moments[0])
        return functional_call(self._mlp, self._weights[newest], (features,)).detach()
