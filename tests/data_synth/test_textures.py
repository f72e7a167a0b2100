"""Texture lookups: known colours, tiling, and filtering by distance."""

from itertools import pairwise

import numpy as np

from data_synth import surfaces
from data_synth.textures import LEVELS, build_texture, canvas, texel_count


def ramp_texture():
    """Return a texture of 32 x 32 texels of 1 cm whose red channel grows to the right."""
    image = np.zeros((32, 32, 3), np.float32)
    image[..., 0] = (np.arange(32) / 32)[None, :]
    image[:16, :, 1] = 1.0
    return build_texture(image, 0.01)


def lookup(texture, across, up, footprint):
    arrays = [np.atleast_1d(np.float32(value)) for value in (across, up, footprint)]
    return texture.sample(*np.broadcast_arrays(*arrays))


def test_a_fine_lookup_returns_the_texel_itself():
    # The middle of the image lies between texels 15 and 16, so texel 20 is at (20 - 15.5) cm.
    colour = lookup(ramp_texture(), 0.045, 0.05, 0.0)[0]
    np.testing.assert_allclose(colour, [20 / 32, 1.0, 0.0], atol=1e-3)


def test_up_on_the_surface_is_up_in_the_image():
    assert lookup(ramp_texture(), 0.0, 0.1, 0.0)[0, 1] == 1.0
    assert lookup(ramp_texture(), 0.0, -0.1, 0.0)[0, 1] == 0.0


def test_textures_tile():
    first, second = lookup(ramp_texture(), [0.03, 0.03 + 0.32], 0.05, 0.0)
    np.testing.assert_allclose(first, second, atol=1e-3)


def test_a_wide_footprint_sees_the_mean_of_fine_detail():
    rng = np.random.default_rng(0)
    texture = build_texture(rng.uniform(size=(256, 256, 3)).astype(np.float32), 0.005)
    across, up = rng.uniform(-0.6, 0.6, (2, 500)).astype(np.float32)
    deviations = [
        texture.sample(across, up, np.full(500, footprint, np.float32)).std()
        for footprint in (0.005, 0.01, 0.02, 0.04)
    ]
    assert deviations[-1] < 0.2 * deviations[0]
    assert all(np.diff(deviations) < 0)


def test_pyramid_levels_keep_the_mean():
    texture = surfaces.wallpaper(np.random.default_rng(1), (1.0, 1.0), [(0.5, 0.4, 0.3)] * 2)
    means = [level.mean() for level in texture.levels]
    np.testing.assert_allclose(means, means[0], atol=1e-4)
    assert len(texture.levels) == LEVELS


def test_sides_can_be_halved_down_the_pyramid():
    assert texel_count(1.0, 0.006) % 2 ** (LEVELS - 1) == 0
    assert texel_count(1.0, 0.006) * 0.006 >= 1.0


def test_walls_have_contrast_at_every_scale():
    palette = [(0.8, 0.7, 0.55), (0.6, 0.4, 0.3), (0.4, 0.5, 0.4)]
    levels = surfaces.wallpaper(np.random.default_rng(2), (3.0, 2.8), palette).levels
    for fine, coarse in pairwise(levels):
        blown_up = coarse.repeat(2, axis=0).repeat(2, axis=1)
        assert (fine - blown_up).std() > 0.015  # detail that lives between these two scales


def test_the_same_seed_paints_the_same_surface():
    twins = [
        surfaces.poster(np.random.default_rng(3), (0.6, 0.5), [(0.2, 0.3, 0.4), (0.9, 0.2, 0.1)])
        for _ in range(2)
    ]
    assert twins[0].levels[0].tobytes() == twins[1].levels[0].tobytes()


def test_a_white_canvas_is_white():
    assert (canvas((0.2, 0.1), 0.01, (1.0, 1.0, 1.0)) == 255).all()
