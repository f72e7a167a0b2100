"""Bundle problems with known truth, in float64: an off-centre camera with fx != fy on an arc."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from minislam.geometry import Camera, se3_exp
from minislam.tracking.bundle_adjustment import normal_equations
from minislam.tracking.bundle_problem import BundleProblem, BundleState
from minislam.tracking.reprojection import relative_transforms, reproject
from minislam.tracking.schur import assemble_poses
from tests.helpers import generator

STRIDE = 8
CAMERA = Camera(fx=60.0, fy=66.0, cx=33.0, cy=19.0, width=80, height=56)
PIXELS = CAMERA.pixel_grid(STRIDE, torch.float64).reshape(-1, 2)
RAYS = CAMERA.rays(PIXELS)
CELLS = len(RAYS)


@dataclass(frozen=True)
class KnownProblem:
    """A bundle problem and the state that its flow was made from."""

    problem: BundleProblem
    truth: BundleState


def pose_equations(problem: BundleProblem, state: BundleState) -> tuple[Tensor, Tensor]:
    """Return H and g of the poses."""
    found = normal_equations(problem, state)
    return assemble_poses(problem, found.edge_blocks, found.edge_gradients, found.adjoints)


def normal(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64)


def uniform(seed: int, *shape: int) -> Tensor:
    return torch.rand(*shape, generator=generator(seed), dtype=torch.float64)


def poses_on_an_arc(count: int, seed: int) -> Tensor:  # (count, 4, 4)
    """Return T_camera_world of a camera that moves sideways and turns, unsteadily."""
    steady = torch.tensor([0.25, 0.06, 0.05, 0.01, -0.03, 0.02], dtype=torch.float64)
    xi = torch.arange(count)[:, None] * steady + 0.02 * normal(seed, count, 6)
    xi[0] = 0
    return se3_exp(xi)


def all_edges(count: int) -> tuple[Tensor, Tensor]:
    pairs = torch.tensor([(i, j) for i in range(count) for j in range(count) if i != j])
    return pairs[:, 0], pairs[:, 1]


def known_problem(keyframes: int = 4, seed: int = 0) -> KnownProblem:
    """Return a problem with exact flow, no prior, and everything free but the first pose."""
    poses = poses_on_an_arc(keyframes, seed)
    disparities = 0.2 + 0.3 * uniform(seed + 1, keyframes, CELLS)
    source, target = all_edges(keyframes)
    transforms = relative_transforms(poses, source, target)
    targets, valid = reproject(transforms, disparities[source], RAYS, CAMERA)
    assert valid.all()
    free_poses = torch.arange(keyframes) > 0
    problem = BundleProblem(
        camera=CAMERA,
        rays=RAYS,
        edges_source=source,
        edges_target=target,
        targets=targets,
        weights=0.2 + 0.8 * uniform(seed + 2, *targets.shape),
        prior_disparities=torch.zeros_like(disparities),
        prior_weights=torch.zeros_like(disparities),
        free_poses=free_poses,
        free_disparities=torch.ones(keyframes, dtype=torch.bool),
    )
    return KnownProblem(problem, BundleState(poses, disparities))


def with_prior(known: KnownProblem, weight: float) -> KnownProblem:
    """Return the problem with the true disparities as prior."""
    truth = known.truth.disparities
    problem = replace(
        known.problem, prior_disparities=truth, prior_weights=torch.full_like(truth, weight)
    )
    return replace(known, problem=problem)


def perturbed(known: KnownProblem, size: float, seed: int = 50) -> BundleState:
    """Return a state off the truth by about `size` in all that is free (disparities: 2 size)."""
    problem, truth = known.problem, known.truth
    xi = size * normal(seed, len(problem.free_poses), 6) * problem.free_poses[:, None]
    factors = (2 * size * normal(seed + 1, *truth.disparities.shape)).clamp(-0.5, 0.5)
    disparities = truth.disparities * (1 + factors * problem.free_disparities[:, None])
    return BundleState(se3_exp(xi) @ truth.T_camera_world, disparities)


def distance(a: BundleState, b: BundleState) -> float:
    """Return the largest difference of any number in two states."""
    poses = (a.T_camera_world - b.T_camera_world).abs().max()
    return float(torch.maximum(poses, (a.disparities - b.disparities).abs().max()))


def assert_same_bits(a: BundleState, b: BundleState) -> None:
    assert torch.equal(a.T_camera_world, b.T_camera_world)
    assert torch.equal(a.disparities, b.disparities)


def scaled(state: BundleState, factor: float) -> BundleState:
    """Return the same views of a world that is `factor` times as large."""
    poses = state.T_camera_world.clone()
    poses[:, :3, 3] *= factor
    return BundleState(poses, state.disparities / factor)


def two_fixed_poses(known: KnownProblem) -> KnownProblem:
    """Fix the second pose as well: then nothing is free to scale, and the truth is unique."""
    free_poses = known.problem.free_poses.clone()
    free_poses[1] = False
    return replace(known, problem=replace(known.problem, free_poses=free_poses))


def noisy(known: KnownProblem, sigma: float, seed: int = 9) -> BundleProblem:
    targets = known.problem.targets
    return replace(known.problem, targets=targets + sigma * normal(seed, *targets.shape))
