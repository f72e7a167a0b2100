"""The constants of a bundle adjustment, Eq. (5), and its unknowns."""

from dataclasses import dataclass

from torch import Tensor

from minislam.geometry import Camera
from minislam.tracking.safeguards.robust import RobustKernel


@dataclass(frozen=True)
class BundleProblem:
    """Everything that is constant while poses and disparities are optimised."""

    camera: Camera
    rays: Tensor  # (N, 3) of the grid cells, z = 1
    edges_source: Tensor  # (E,) int64 keyframe index, sorted or not
    edges_target: Tensor  # (E,) int64
    targets: Tensor  # (E, 2, N) px, flow targets p~
    weights: Tensor  # (E, 2, N) Sigma / beta^2, >= 0
    prior_disparities: Tensor  # (K, N) 1 / D~ [1/world unit]
    prior_weights: Tensor  # (K, N) lambda_4 fx^2 M [px^2 per disparity^2], 0 without a prior
    free_poses: Tensor  # (K,) bool
    free_disparities: Tensor  # (K,) bool
    robust: RobustKernel | None = None  # None: plain least squares
    disparity_damping: Tensor | None = None  # (K, N) px^2; None: a fraction of the mean diagonal
    free_focal: bool = False  # f is one more unknown, not in the paper
    shift_columns: Tensor | None = None  # (E, 2, 2, N) px per unit of either shift; None: held


@dataclass(frozen=True)
class BundleState:
    """The unknowns."""

    T_camera_world: Tensor  # (K, 4, 4) float64
    disparities: Tensor  # (K, N) 1/world unit
    log_focal: float = 0.0  # s = ln(f / f of the problem's camera)
    # Two unknowns that move the targets: readouts [s] (rolling_shutter.py), or k1 and k2 (lens.py).
    shifts: tuple[float, float] = (0.0, 0.0)
