from copy import deepcopy
from dataclasses import replace

import pytest
import torch

from minislam.evaluation import psnr
from minislam.mapping.safeguards import (
    confirmed_beta,
    doubted_error,
    is_wrong,
    least_weight,
    static_blending,
    without_acquitted,
)
from minislam.uncertainty import RenderingError, UncertaintyConfig
from minislam.uncertainty.weights import (
    BETA_OF_MASK,
    MAPPING_CUT,
    clipped_beta,
    mapping_weight,
    weight_of,
)
from tests.mapping.plane_scene import CAMERA, CONFIG, GRID, make_mapper, wall_keyframe

# Known answers


def test_confirmation_lessens_doubt_but_not_a_beta_above_the_cut():
    beta = torch.tensor([[0.2, 1.0, 1.4, 1.6, 3.0]])
    assert confirmed_beta(beta, None) is beta
    confirmation = torch.tensor([[-1.0, 0.5, 1.0, 1.0, 1.0]])
    expected = torch.tensor([[0.2, 0.8, 0.84, 1.6, 3.0]])
    torch.testing.assert_close(confirmed_beta(beta, confirmation), expected)


def test_the_rendering_error_of_what_is_confirmed_fades():
    error = RenderingError(torch.ones(1, 3), torch.full((1, 3), 2.0), torch.ones(1, 3))
    assert doubted_error(error, None) is error
    faded = doubted_error(error, torch.tensor([[0.0, 0.5, 1.0]]))
    torch.testing.assert_close(faded.ssim, torch.tensor([[1.0, 0.25, 0.0]]))
    torch.testing.assert_close(faded.depth, torch.tensor([[2.0, 0.5, 0.0]]))
    assert torch.equal(doubted_error(error, torch.full((1, 3), -1.0)).ssim, error.ssim)
    assert faded.opacity is error.opacity


def test_what_views_look_through_is_acquitted_where_the_map_shows_it_rightly():
    # At lambda_3 = .5 the best beta is 2 sqrt(L): .4 and .56 for these errors. A hole has none.
    ssim, opacity = torch.tensor([[[0.04, 0.08, 0.04, 0.0]], [[1.0, 1.0, 1.0, 0.0]]])
    error = RenderingError(ssim, torch.zeros_like(ssim), opacity)
    confirmation = torch.tensor([[-1.0, -0.5, 0.7, -0.6]])
    left = without_acquitted(confirmation, error, UncertaintyConfig())
    torch.testing.assert_close(left, torch.tensor([[0.0, -0.5, 0.7, 0.0]]))
    assert without_acquitted(None, error, UncertaintyConfig()) is None


def betas(*modes: tuple[float, int]) -> torch.Tensor:
    """Return as many betas around each value as asked for."""
    generator = torch.Generator().manual_seed(1)
    around = [mean + 0.05 * torch.randn(n, generator=generator) for mean, n in modes]
    return torch.cat(around).clamp_min(0.01)


def test_what_moves_in_this_clip_is_excluded_though_its_beta_is_below_the_usual_cut():
    least = least_weight(betas((0.1, 900), (1.15, 100)))
    excluded = [float(mapping_weight(torch.full((2, 2), beta), CAMERA, least).max()) == 0
                for beta in (0.80, 0.84, 0.89, 1.15)]  # fmt: skip
    assert excluded == [False, False, True, True]  # three quarters of 1.15 are .86


def test_the_last_bin_of_the_lower_mode_is_no_part_of_the_upper_one():
    lower, upper = torch.linspace(0.19, 0.195, 9000), torch.linspace(1.2, 1.5, 1000)
    at_cut = weight_of(clipped_beta(0.75 * upper.mean()))
    found = least_weight(torch.cat([lower, upper]))
    assert found > MAPPING_CUT
    assert found == pytest.approx(float(at_cut), rel=1e-3)


@pytest.mark.parametrize(
    "modes",
    [
        [(0.1, 1000)],  # nothing moves
        [(0.1, 900), (0.7, 100)],  # nothing moves, but a part is not shown well
        [(0.4, 500), (1.9, 500)],  # the usual cut lies below
        [(0.1, 500), (4.47, 500)],  # given masks
        [(0.3, 1)],
    ],
)
def test_otherwise_the_usual_cut_stays(modes):
    assert least_weight(betas(*modes)) == MAPPING_CUT


# Cells of (beta, L'_SSIM, L_depth, opacity); the least weight excludes from a beta of .86 on.
RIGHT, BY_COLOUR, BY_DEPTH = (1.1, 0.1, 0.0, 1.0), (1.1, 0.25, 0.0, 1.0), (1.1, 0.0, 1.25, 1.0)
HOLE, ELSEWHERE = (1.1, 0.0, 0.0, 0.5), (0.8, 4.0, 0.0, 1.0)


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        ([BY_COLOUR, BY_DEPTH, RIGHT], True),
        ([BY_COLOUR, RIGHT], True),  # half of them
        ([BY_COLOUR, RIGHT, RIGHT], False),
        ([BY_COLOUR, RIGHT, ELSEWHERE, ELSEWHERE, HOLE], True),
        ([RIGHT, BY_COLOUR, RIGHT, ELSEWHERE, HOLE], False),
        ([HOLE, ELSEWHERE], True),  # nothing is known
    ],
)
def test_an_upper_mode_is_kept_where_the_map_explains_most_of_it(cells, expected: bool):
    beta, ssim, depth, opacity = torch.tensor(cells).T
    least = float(weight_of(clipped_beta(torch.tensor(0.86))))
    assert (
        is_wrong(RenderingError(ssim, depth, opacity), beta, least, UncertaintyConfig()) == expected
    )


def test_with_another_lambda_3_another_beta_is_best():
    error = RenderingError(*torch.tensor([[0.1], [0.0], [1.0]]))
    beta = torch.tensor([1.0])
    least = float(weight_of(clipped_beta(torch.tensor(0.6))))  # 2 sqrt(0.1) = 0.63
    assert is_wrong(error, beta, least, UncertaintyConfig())
    assert not is_wrong(error, beta, least, UncertaintyConfig(lambda_log=1.0))  # sqrt(0.2) = 0.45


# Whole refinements


def moving_square(iterations: int, confirms: bool = True) -> tuple[object, list[object]]:
    """Refine a map in which a square moves; its beta is 1.15. Return the mapper half way, too."""
    keyframes = [wall_keyframe(k, mover_column=4 + 4 * k) for k in range(3)]
    if confirms:
        keyframes = [replace(keyframe, confirmation=torch.zeros(GRID)) for keyframe in keyframes]
    mapper, halves = make_mapper(replace(CONFIG, init_iterations=2)), []
    mapper.predict_beta = lambda features: 0.1 + 1.05 * features[..., 1]
    mapper.initialise(keyframes)

    def remember(done: int, total: int) -> None:
        if done == total // 2:
            halves.append(deepcopy(mapper))

    mapper.refine(iterations, remember)
    return mapper, halves


def test_half_way_all_that_moves_leaves_the_map():
    mapper, (half,) = moving_square(48)
    movers = [int((m.gaussians.means[:, 2] < 1.5).sum()) for m in (half, mapper)]
    assert half.least_weight == MAPPING_CUT < mapper.least_weight
    assert movers[1] < 0.4 * movers[0]


@pytest.mark.parametrize("moves", [False, True])
def test_what_looks_like_a_mover_is_kept_where_the_map_is_right(moves: bool):
    # The features are those of something that moves, but only in one case it is there.
    keyframes = []
    for index in range(3):
        shown = wall_keyframe(index, mover_column=4 + 4 * index if moves else None)
        features = wall_keyframe(index, mover_column=4 + 4 * index).features
        confirmation = torch.zeros(GRID)
        keyframes.append(replace(shown, features=features, confirmation=confirmation))
    mapper = make_mapper(replace(CONFIG, init_iterations=60))
    mapper.predict_beta = lambda features: 0.1 + 1.05 * features[..., 1]
    mapper.initialise(keyframes)
    mapper.refine(48)
    assert (mapper.least_weight > MAPPING_CUT) == moves


@pytest.mark.parametrize("moves", [False, True])
def test_what_views_look_through_is_painted_into_the_map_only_if_it_stands_still(moves: bool):
    # To the MLP the square is as static as the wall; no image has a depth where it is.
    images = []
    for index in range(3):
        column = 4 + 8 * index
        image = wall_keyframe(index, mover_column=column if moves else None)
        depth = image.depth.clone()
        depth[8:16, column : column + 8] = 0
        looked_through = -wall_keyframe(index, mover_column=column).features[..., 1]
        images.append(replace(image, depth=depth, confirmation=looked_through))
    mapper = make_mapper(replace(CONFIG, init_iterations=60))
    mapper.predict_beta = lambda features: torch.full(features.shape[:2], 0.1)
    mapper.initialise(images)
    mapper.refine(24)
    for image, before in zip(mapper.images, images, strict=True):
        assert torch.equal(image.confirmation < 0, (before.confirmation < 0) & moves)
        assert (mapper.beta_of(image)[image.confirmation < 0] == BETA_OF_MASK).all()
    empty = wall_keyframe(1)
    assert psnr(mapper.render(empty.T_camera_world).color, empty.image) > 25


def test_without_confirmation_the_usual_cut_stays():
    mapper, _ = moving_square(48, confirms=False)
    assert mapper.least_weight == MAPPING_CUT


def test_before_a_keyframe_was_rendered_twice_the_usual_cut_stays():
    mapper, _ = moving_square(8)  # the half are 4 renderings of 3 keyframes
    assert mapper.least_weight == MAPPING_CUT


@pytest.mark.slow
def test_a_refinement_that_is_resumed_half_way_ends_at_the_same_map():
    whole, (resumed,) = moving_square(48)
    resumed.predict_beta = whole.predict_beta
    resumed.refine(48, None, 24)
    assert resumed.least_weight == whole.least_weight
    assert torch.equal(resumed.gaussians.means, whole.gaussians.means)


# What nothing static shows


def test_the_blending_weights_of_two_parts_of_a_view_are_those_of_all():
    mapper, pose = make_mapper(), wall_keyframe(1).T_camera_world
    mapper.initialise([wall_keyframe(0), wall_keyframe(2)])
    left = torch.zeros(CAMERA.height, CAMERA.width)
    left[:, : CAMERA.width // 3] = 0.5  # any weight but 0 is static
    weights = left, (left == 0) * 1.0
    parts = [static_blending(mapper.gaussians, CAMERA, pose, w)[0] for w in weights]
    torch.testing.assert_close(parts[0][0] + parts[1][0], parts[0][1], atol=1e-4, rtol=1e-4)
    assert torch.equal(parts[0][1], mapper.render(pose).weight_sums)
    everywhere = static_blending(mapper.gaussians, CAMERA, pose, torch.ones_like(left))[0]
    assert torch.equal(everywhere[0], everywhere[1]) and torch.equal(everywhere[1], parts[0][1])
    pixels = CAMERA.project(mapper.gaussians.means.detach() @ pose[:3, :3].T.float() + pose[:3, 3])
    is_far_right = pixels[:, 0] > CAMERA.width / 2
    assert parts[0][0][is_far_right].max() < 1e-3 < parts[1][0][is_far_right].max()


@pytest.mark.slow
def test_what_only_moving_pixels_show_leaves_the_map_at_the_end():
    on_the_right = torch.arange(CAMERA.width).expand(CAMERA.height, CAMERA.width) >= 20
    mapper = make_mapper()
    mapper.initialise([wall_keyframe(0), wall_keyframe(1)])
    before = len(mapper.gaussians)
    stray = mapper.gaussians.detach().keep(torch.arange(before) < 5)
    mapper._optimizer.append(replace(stray, means=stray.means + 100))  # out of all views
    mapper.refine(0)
    assert len(mapper.gaussians) >= 0.98 * before and mapper.gaussians.means.max() < 50
    mapper.images = [replace(k, moving_mask=on_the_right) for k in mapper.images]
    mapper.refine(0)
    pose = mapper.images[0].T_camera_world
    seen = [mapper.render(pose).opacity[:, columns] for columns in (slice(2, 16), slice(27, None))]
    assert seen[0].min() > 0.8 and seen[1].max() < 0.1


@pytest.mark.slow
def test_where_nothing_is_static_the_map_stays():
    mapper = make_mapper()
    mapper.initialise([wall_keyframe(0), wall_keyframe(1)])
    before = len(mapper.gaussians)
    everywhere = torch.ones(CAMERA.height, CAMERA.width, dtype=torch.bool)
    mapper.images = [replace(k, moving_mask=everywhere) for k in mapper.images]
    mapper.refine(0)
    assert len(mapper.gaussians) == before > 0
