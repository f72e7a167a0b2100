"""A pose is pulled back to where the map looks like the image."""

from dataclasses import replace

import pytest
import torch

from minislam.geometry import Camera, se3_exp, se3_inverse, se3_log, transform_points
from minislam.mapping import Mapper, MappingConfig, pose_refinement
from minislam.mapping.config import PoseRefinementConfig
from minislam.mapping.pose_refinement import (
    curvature,
    image_slope,
    refine_pose,
    rerendering_loss,
)
from minislam.splatting import GaussianMap, Rendering, render
from minislam.uncertainty import UncertaintyConfig
from tests.helpers import assert_gradients_close, generator, numerical_gradient
from tests.mapping.plane_scene import CAMERA, wall_keyframe

pytestmark = pytest.mark.slow

CONFIG = PoseRefinementConfig(iterations=8, tolerance=0.01)
BLACK = torch.zeros(3)
OFF = se3_exp(torch.tensor([0.03, -0.02, 0.04, 0.01, -0.015, 0.02], dtype=torch.float64))


def textured_wall() -> GaussianMap:
    """Return overlapping Gaussians about 2 units away, opaque and of smooth colour.

    Their depths differ: at equal depths the smallest turn would change which one is in front.
    """
    grid = torch.stack(
        torch.meshgrid(torch.linspace(-2, 2, 61), torch.linspace(-1.6, 1.6, 49), indexing="xy"), -1
    ).reshape(-1, 2)
    count = len(grid)
    x, y = grid.unbind(-1)
    depth = 1.9 + 0.2 * torch.rand(count, 1, generator=generator(0))
    colors = [0.5 + 0.3 * torch.sin(3 * w) for w in (x + y, 2 * y - x, 1.3 * x)]
    return GaussianMap(
        torch.cat([grid, depth], 1),
        torch.tensor([1.0, 0, 0, 0]).expand(count, 4).clone(),
        torch.full((count, 3), -2.7),
        torch.full((count,), 3.0),
        torch.stack(colors, -1),
        torch.zeros(count, dtype=torch.int64),
    )


def distance(first: torch.Tensor, second: torch.Tensor) -> float:
    return float(se3_log(first @ se3_inverse(second)).norm())


def picture_shift(first: torch.Tensor, second: torch.Tensor) -> float:
    """Return how far the points of the wall move in the image between two poses [px], mean.

    A slide and a turn look much alike on a wall; what refinement promises is the picture.
    """
    pixels = CAMERA.pixel_grid(4, dtype=torch.float64).reshape(-1, 2)
    points = CAMERA.backproject(pixels, torch.full((len(pixels),), 2.0, dtype=torch.float64))
    points = transform_points(se3_inverse(first), points)
    return float((CAMERA.project(transform_points(second, points)) - pixels).norm(dim=1).mean())


def refined(image: torch.Tensor, weight: torch.Tensor, start: torch.Tensor) -> torch.Tensor:
    return refine_pose(textured_wall(), CAMERA, start, image, weight, BLACK, CONFIG)


TRUE_POSE = torch.eye(4, dtype=torch.float64)
TRUE_IMAGE = render(textured_wall(), CAMERA, TRUE_POSE.float(), BLACK).color


# Known answers


def test_the_pose_from_which_the_image_was_rendered_is_found_again():
    pose = refined(TRUE_IMAGE, torch.ones(24, 32), OFF)
    assert distance(OFF, TRUE_POSE) > 0.05
    assert distance(pose, TRUE_POSE) < 3e-3


def test_a_mover_of_weight_zero_does_not_pull_and_with_weight_one_it_does():
    image, weight = TRUE_IMAGE.clone(), torch.ones(24, 32)
    image[:, :20] = TRUE_IMAGE[:, 2:22]  # most of the image has gone 2 px to the left
    weight[:, :20] = 0
    masked = distance(refined(image, weight, OFF), TRUE_POSE)
    assert masked < 1e-2
    assert distance(refined(image, torch.ones(24, 32), OFF), TRUE_POSE) > 4 * masked


def test_a_frame_between_two_keyframes_is_refined_by_the_mapper():
    config = MappingConfig(image_scale=1.0, init_iterations=120, pose_refinement=CONFIG)
    mapper = Mapper(CAMERA, config, UncertaintyConfig(), feature_dimension=3, seed=0)
    mapper.initialise([wall_keyframe(0), wall_keyframe(2)])
    between = wall_keyframe(1)
    start = OFF @ between.T_camera_world
    beta = mapper.predict_beta(between.features)
    (pose,) = mapper.refine_poses([start], [between.image], [beta])
    assert picture_shift(start, between.T_camera_world) > 0.5
    assert picture_shift(pose, between.T_camera_world) < 0.2


# Identities


def test_a_pose_that_is_right_stays():
    pose = refined(TRUE_IMAGE, torch.ones(24, 32), TRUE_POSE)
    assert distance(pose, TRUE_POSE) < 1e-5


def test_no_step_raises_the_rendering_error():
    weight = torch.ones(24, 32)

    def loss(pose: torch.Tensor) -> float:
        rendering = render(textured_wall(), CAMERA, pose, BLACK)
        return float(rerendering_loss(rendering, TRUE_IMAGE, weight))

    far = se3_exp(8 * se3_log(OFF))
    assert loss(refined(TRUE_IMAGE, weight, far)) <= loss(far)
    once = refine_pose(
        textured_wall(), CAMERA, OFF, TRUE_IMAGE, weight, BLACK, replace(CONFIG, iterations=1)
    )
    assert loss(refined(TRUE_IMAGE, weight, OFF)) < loss(once) < loss(OFF)


# Gradients


def random_rendering(seed: int) -> Rendering:
    values = torch.rand(5, 6, 5, generator=generator(seed), dtype=torch.float64)
    empty = torch.zeros(0, dtype=torch.float64)
    return Rendering(values[..., :3], 1 + values[..., 3], values[..., 4], empty)


def test_loss_gradient_agrees_with_finite_differences_and_opacity_is_held():
    rendering, image = random_rendering(0), random_rendering(1).color
    weight = random_rendering(2).depth

    def loss(color: torch.Tensor) -> torch.Tensor:
        return rerendering_loss(rendering._replace(color=color), image, weight)

    color = rendering.color.clone().requires_grad_()
    opacity = rendering.opacity.clone().requires_grad_()
    held = rendering._replace(color=color, opacity=opacity)
    rerendering_loss(held, image, weight).backward()
    assert opacity.grad is None
    assert_gradients_close(color.grad, numerical_gradient(loss, rendering.color), relative=1e-6)


@pytest.mark.parametrize("principal_point", [(15.5, 11.5), (12.0, 14.0)])
def test_the_curvature_is_that_of_the_rendering(principal_point: tuple[float, float]):
    """The columns of J, from differences of renderings: about the same Gauss-Newton matrix.

    A wrong sign, a missing term or a forgotten focal length would be off by more than 15 %.
    """
    camera = Camera(30.0, 33.0, *principal_point, 32, 24)
    wall = textured_wall()
    inner = torch.zeros(24, 32)
    inner[4:-4, 4:-4] = 1  # at the border the slope is unknown
    here = render(wall, camera, TRUE_POSE.float(), BLACK)
    image = here.color + 0.05
    found = curvature(here, image, inner, camera)
    columns = []
    for axis in range(6):
        xi = torch.zeros(6, dtype=torch.float64)
        xi[axis] = 0.01
        ahead, behind = (render(wall, camera, se3_exp(s * xi), BLACK).color for s in (1, -1))
        columns.append(((ahead - behind) / 0.02).reshape(-1))
    jacobian = torch.stack(columns, -1).double()
    factor = (inner * here.opacity)[..., None] / ((here.color - image) ** 2 + 1e-4).sqrt()
    factor = factor.double().reshape(-1, 1) / factor.numel()
    expected = jacobian.T @ (factor * jacobian)
    assert float((found - expected).norm() / expected.norm()) < 0.15


def test_slope_of_a_ramp():
    u, v = torch.meshgrid(torch.arange(6.0), torch.arange(5.0), indexing="xy")
    ramp = (2 * u - 3 * v)[..., None].expand(5, 6, 3)
    slope = image_slope(ramp)
    expected = torch.tensor([2.0, -3.0])[:, None, None, None].expand(2, 3, 4, 3)
    torch.testing.assert_close(slope[:, 1:-1, 1:-1], expected)


# Degenerate input


@pytest.mark.parametrize("case", ["empty map", "all moving", "uniform picture", "behind"])
def test_where_the_picture_says_nothing_the_pose_stays(case: str):
    wall, weight, start = textured_wall(), torch.ones(24, 32), OFF
    if case == "empty map":
        wall = GaussianMap.empty()
    if case == "all moving":
        weight = torch.zeros(24, 32)
    if case == "uniform picture":
        wall = replace(wall, colors=torch.full_like(wall.colors, 0.5))
    if case == "behind":
        start = torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64))
    pose = refine_pose(wall, CAMERA, start, TRUE_IMAGE, weight, BLACK, CONFIG)
    assert torch.isfinite(pose).all()
    assert distance(pose, start) < 1e-9 or case == "uniform picture"


def test_a_step_moves_the_image_by_its_slide_over_the_mean_depth_and_by_its_turn():
    half = torch.full((5, 6), 0.5)
    rendering = Rendering(
        color=torch.zeros(5, 6, 3), depth=4 * half, opacity=half, weight_sums=half
    )
    for step, moved in (([0, 0.2, 0, 0, 0, 0], 0.05), ([0, 0, 0, 0, 0.01, 0], 0.01)):
        found = pose_refinement._motion(torch.tensor(step), rendering, CAMERA)
        assert found == pytest.approx(moved * CAMERA.fx)
