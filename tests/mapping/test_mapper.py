from dataclasses import replace

import pytest
import torch

from minislam.errors import InputError
from minislam.geometry import se3_exp
from minislam.mapping.views import view_of
from minislam.records import Frame
from minislam.splatting.constants import MIN_ALPHA
from minislam.state.memory import SHELF
from minislam.uncertainty import UncertaintyConfig
from tests.mapping.plane_scene import CAMERA, CONFIG, make_mapper, wall_keyframe

pytestmark = pytest.mark.slow


def psnr(first: torch.Tensor, second: torch.Tensor) -> float:
    return float(-10 * ((first - second) ** 2).mean().log10())


# Known answers


def test_a_static_wall_is_learnt_and_seen_from_between_the_keyframes():
    mapper = make_mapper()
    mapper.initialise([wall_keyframe(0), wall_keyframe(2)])
    held_out = wall_keyframe(1)
    rendering = mapper.render(held_out.T_camera_world)
    inner = (slice(2, -2), slice(2, -2))
    assert psnr(rendering.color[inner], held_out.image[inner]) > 25
    assert (rendering.depth[inner] - 2).abs().mean() < 0.1
    assert mapper.history["L_uncer"][-1] < mapper.history["L_uncer"][0]


def test_a_wall_that_was_exposed_darker_has_its_colour_in_the_map():
    exposure, errors = torch.tensor([0.5, 0.6, 0.7]), []
    for known in (exposure, None):
        mapper, dark = make_mapper(), wall_keyframe(1)
        dark = replace(dark, pixels=dark.image * exposure)
        first = replace(wall_keyframe(0), exposure=None if known is None else torch.ones(3))
        mapper.initialise([first, replace(dark, exposure=known)])
        shown = mapper.render(wall_keyframe(2).T_camera_world).color
        errors.append(float((shown - wall_keyframe(2).image).square().mean()))
        assert len(mapper.exposures) == (0 if known is None else 2)
    assert errors[0] < 0.2 * errors[1]  # measured: .11


def test_the_fraction_that_is_shown_counts_holes_but_not_where_something_moves():
    shown = []
    on_the_right = torch.arange(32).expand(24, 32) >= 16
    nowhere = torch.zeros_like(on_the_right)
    for holes, mask in ((nowhere, None), (on_the_right, None), (on_the_right, on_the_right)):
        mapper, keyframe = make_mapper(), replace(wall_keyframe(0), moving_mask=mask)
        keyframe.depth[holes] = 0
        mapper.initialise([keyframe])
        mapper.refine(0)
        shown += mapper.shown
    assert shown[0] == 1 and shown[2] == 1
    assert shown[1] == pytest.approx(0.5, abs=0.1)  # a Gaussian reaches over the border


def test_an_empty_map_shows_nothing():
    mapper = make_mapper()
    mask = torch.ones(24, 32, dtype=torch.bool)
    mapper.initialise([replace(wall_keyframe(0), moving_mask=mask)])
    mapper.refine(0)
    assert len(mapper.gaussians) == 0 and mapper.shown == [0]


def test_exposures_are_those_of_the_views():
    mapper = make_mapper()
    told = torch.tensor([0.5, 0.6, 0.7])
    mapper.initialise([wall_keyframe(0), replace(wall_keyframe(1), exposure=told)])
    assert list(mapper.exposures) == [5]
    assert view_of(mapper.images[1], CAMERA).exposure is mapper.exposures[5]


def test_a_mover_becomes_uncertain_and_fades_from_the_map():
    # The square is elsewhere in each keyframe: no static map can explain it.
    mapper = make_mapper(replace(CONFIG, init_iterations=250))
    mapper.initialise([wall_keyframe(k, mover_column=4 + 6 * k) for k in range(4)])
    beta = mapper.predict_beta(wall_keyframe(0, mover_column=4).features)
    assert beta[2, 1] > 3 * beta[0, 0]
    empty = wall_keyframe(1)
    assert psnr(mapper.render(empty.T_camera_world).color, empty.image) > 18


def test_an_mlp_that_took_everything_to_move_at_first_hides_nothing_of_a_static_wall():
    mapper, keyframes = make_mapper(), [wall_keyframe(k) for k in range(3)]
    with torch.no_grad():
        mapper.mlp.biases[-1].fill_(4.0)
    beta = mapper.predict_beta(keyframes[0].features)
    assert beta.min() > 3 and (mapper.static_weight(beta, CAMERA) == 0).all()
    mapper.initialise(keyframes)
    rendering = mapper.render(keyframes[1].T_camera_world)
    assert psnr(rendering.color[2:-2, 2:-2], keyframes[1].image[2:-2, 2:-2]) > 25
    beta = mapper.predict_beta(keyframes[0].features)
    assert (mapper.static_weight(beta, CAMERA) > 0).all()


def test_the_first_map_sees_every_keyframe_some_times_however_many_there_are():
    mapper = make_mapper(replace(CONFIG, init_iterations=1))
    mapper.initialise([wall_keyframe(k) for k in range(5)])
    assert len(mapper.history["L_render"]) == 20


@pytest.mark.parametrize(("init", "expected"), [(60, 15), (14, 14), (1, 12)])
def test_online_the_first_keyframes_get_no_more_iterations_than_others(init: int, expected: int):
    mapper = make_mapper(replace(CONFIG, init_iterations=init, keyframe_iterations=5))
    mapper.initialise([wall_keyframe(k) for k in range(3)], online=True)
    assert len(mapper.history["L_render"]) == expected


def test_gaussians_on_a_mover_are_removed_and_not_inserted_again_once_the_mlp_knows_it():
    mapper = make_mapper(replace(CONFIG, init_iterations=1))
    mapper.initialise([wall_keyframe(0, mover_column=12)])
    mover = mapper.gaussians.means[:, 2] < 1.5
    assert mover.sum() >= 12

    # An MLP that answers the mover's features (0, 1, 0) with a large beta.
    mapper.predict_beta = lambda features: 0.1 + 5 * features[..., 1]
    mapper._replace_dynamic_gaussians()
    assert (mapper.gaussians.means[:, 2] < 1.5).sum() < 0.4 * mover.sum()
    assert (mapper.gaussians.means[:, 2] > 1.5).sum() > 100


@pytest.mark.parametrize("mean_background", [True, False])
def test_what_no_keyframe_sees_has_the_mean_colour_or_is_black(mean_background):
    mapper = make_mapper(replace(CONFIG, init_iterations=1, mean_background=mean_background))
    first = wall_keyframe(0)
    mapper.initialise([first])
    beside = first.T_camera_world.clone()
    beside[0, 3] = -100
    expected = first.image.mean((0, 1)) if mean_background else torch.zeros(3)
    torch.testing.assert_close(mapper.render(beside).color[10, 10], expected)


# Identities


def test_two_runs_with_one_seed_are_equal_to_the_bit():
    maps = []
    for _ in range(2):
        mapper = make_mapper(replace(CONFIG, init_iterations=10))
        mapper.initialise([wall_keyframe(0), wall_keyframe(1)])
        mapper.integrate(wall_keyframe(2))
        mapper.refine(4)
        maps.append(mapper)
    first, second = maps
    assert torch.equal(first.gaussians.means, second.gaussians.means)
    assert torch.equal(first.mlp.weights[0], second.mlp.weights[0])
    assert first.history["L_render"] == second.history["L_render"]


def test_a_restored_mapper_has_the_images_that_it_was_given():
    # They may differ from the frames of the sequence: a rolling shutter is undone in them.
    def never(index: int) -> Frame:
        raise AssertionError(index)

    mapper, restored = make_mapper(replace(CONFIG, init_iterations=10)), make_mapper()
    mapper.initialise([wall_keyframe(0), replace(wall_keyframe(1), exposure=torch.ones(3))])
    restored.restore_state(mapper.saved_state(), never)
    for found, known in zip(restored.images, mapper.images, strict=True):
        assert torch.equal(found.pixels, known.pixels) and found.frame_index == known.frame_index
        assert SHELF.holds(found.pixels)
    assert list(restored.exposures) == [5]


def test_a_rigid_motion_of_all_keyframes_moves_the_map_with_them():
    mapper = make_mapper(replace(CONFIG, init_iterations=10))
    mapper.initialise([wall_keyframe(k) for k in range(3)])
    old = torch.stack([keyframe.T_camera_world for keyframe in mapper.images])
    before = mapper.render(old[1]).color
    motion = se3_exp(torch.tensor([0.3, 0.1, -0.2, 0.1, 0.4, 0.2], dtype=torch.float64))
    mapper.update_poses(old @ motion)
    moved = (mapper.render((old @ motion)[1]).color - before).abs()
    # Where an alpha is as small as the smallest that counts, rounding decides whether it does.
    assert float(moved.quantile(0.98)) < 1e-4 and float(moved.max()) < 2 * MIN_ALPHA


def test_covered_pixels_are_not_inserted_again():
    mapper = make_mapper()
    mapper.initialise([wall_keyframe(0)])
    count = len(mapper.gaussians)
    mapper.integrate(wall_keyframe(1))
    # 0.1 to the right at depth 2 and 30 px of focal length uncovers 1.5 of 32 columns.
    assert len(mapper.gaussians) - count < 0.25 * count


def test_a_frame_between_keyframes_is_compared_with_the_map_and_inserts_nothing():
    first, brightness = wall_keyframe(0), []
    dark = replace(wall_keyframe(1), pixels=0.5 * wall_keyframe(1).image, inserts=False)
    for others in ([], [dark]):
        mapper = make_mapper()
        mapper.initialise([first, *others])
        assert set(mapper.gaussians.anchor_keyframe.tolist()) == {0}
        brightness.append(float(mapper.render(first.T_camera_world).color.mean()))
    assert brightness[1] < 0.95 * brightness[0]  # the map shows a mean of the two


def test_in_fast_mode_most_keyframes_wait_for_their_optimisation():
    mapper = make_mapper(replace(CONFIG, init_iterations=4, keyframe_stride=3))
    mapper.initialise([wall_keyframe(0)])
    counts = []
    for index in range(1, 7):
        mapper.integrate(wall_keyframe(index))
        counts.append(len(mapper.history["L_render"]))
    # Keyframes 3 and 6 are optimised, with five iterations each; all others are only inserted.
    assert counts == [4, 4, 9, 9, 9, 14]
    assert set(mapper.gaussians.anchor_keyframe.tolist()) == set(range(7))


def test_given_masks_take_the_place_of_the_mlp():
    keyframes = []
    for index in range(3):
        keyframe = wall_keyframe(index, mover_column=4 + 6 * index)
        mask = keyframe.depth < 1.5
        keyframes.append(replace(keyframe, moving_mask=mask))
    mapper = make_mapper(CONFIG, UncertaintyConfig(given_masks=True))
    before = [p.detach().clone() for p in mapper.mlp.parameters()]
    mapper.initialise(keyframes[:2])
    mapper.integrate(keyframes[2])
    assert all(torch.equal(a, b) for a, b in zip(before, mapper.mlp.parameters(), strict=True))
    weight = mapper.static_weight(mapper.beta_of(mapper.images[0]), CAMERA)
    assert torch.equal(weight == 0, keyframes[0].moving_mask)
    assert (mapper.gaussians.means[:, 2] < 1.5).sum() == 0
    empty = wall_keyframe(0)
    assert psnr(mapper.render(empty.T_camera_world).color, empty.image) > 24


# Degenerate input


def test_sparse_depth_and_arbitrary_units_are_enough():
    keyframes = []
    for index in range(2):
        keyframe = wall_keyframe(index)
        depth = torch.zeros_like(keyframe.depth)
        depth[::2, ::3] = 1000 * keyframe.depth[::2, ::3]
        pose = keyframe.T_camera_world.clone()
        pose[:3, 3] *= 1000
        keyframes.append(replace(keyframe, depth=depth, T_camera_world=pose))
    mapper = make_mapper()
    mapper.initialise(keyframes)
    assert mapper.median_depth == 2000
    rendering = mapper.render(keyframes[0].T_camera_world)
    inner = (slice(4, -4), slice(4, -4))
    assert psnr(rendering.color[inner], keyframes[0].image[inner]) > 20


def test_a_black_keyframe_without_depth_changes_nothing_for_the_worse():
    mapper = make_mapper()
    mapper.initialise([wall_keyframe(0)])
    black = replace(wall_keyframe(1), pixels=torch.zeros(24, 32, 3), depth=torch.zeros(24, 32))
    mapper.integrate(black)
    assert torch.isfinite(mapper.gaussians.means).all()
    first = wall_keyframe(0)
    assert psnr(mapper.render(first.T_camera_world).color, first.image) > 20


def test_a_map_that_lost_all_its_gaussians_recovers_with_the_next_keyframe():
    mapper = make_mapper(replace(CONFIG, init_iterations=1))
    mapper.initialise([wall_keyframe(0)])
    mapper._optimizer.keep(torch.zeros(len(mapper.gaussians), dtype=torch.bool))
    assert mapper.render(wall_keyframe(0).T_camera_world).opacity.max() == 0
    mapper.integrate(wall_keyframe(1))
    assert len(mapper.gaussians) > 100


# Errors


def test_impossible_calls_are_refused():
    mapper = make_mapper(replace(CONFIG, init_iterations=1))
    with pytest.raises(AssertionError, match="initialise first"):
        mapper.integrate(wall_keyframe(0))
    with pytest.raises(AssertionError, match="at least one image"):
        mapper.initialise([])
    with pytest.raises(InputError, match="some known depth"):
        mapper.initialise([replace(wall_keyframe(0), depth=torch.zeros(24, 32))])
    mapper.initialise([wall_keyframe(0)])
    with pytest.raises(AssertionError, match="2"):
        mapper.update_poses(torch.eye(4, dtype=torch.float64).expand(2, 4, 4))
