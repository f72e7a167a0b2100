"""The ray-caster on scenes whose images are known."""

import numpy as np
import pytest

from data_synth.poses import Intrinsics, look_at, upright
from data_synth.render import (
    AMBIENT,
    DIRECT,
    SHADOW_DEPTH,
    camera_rays,
    enclosing_sphere,
    expose,
    intersect_part,
    lamp_visibility,
    trace,
)
from data_synth.shapes import Box, Capsule, Ellipsoid, Interior, Part
from tests.data_synth.paints import plain

CAMERA = Intrinsics(fx=70.0, fy=72.0, cx=40.3, cy=29.1, width=80, height=60)
LAMP = np.array([0.0, 0.0, 2.5])

ROOM = Part(Interior((6.0, 6.0, 3.0)), upright([0, 0, 1.5]), plain(0.5, 0.5, 0.5))
BALL = Part(Ellipsoid((0.4, 0.4, 0.4)), upright([0.2, 0.5, 1.1]), plain(0.9, 0.1, 0.1))
CRATE = Part(Box((0.6, 0.5, 0.8)), upright([-0.7, 0.8, 0.4], 0.4), plain(0.1, 0.8, 0.2))
POSE = look_at(np.array([0.3, -2.2, 1.5]), np.array([0.0, 1.0, 0.9]))


def world_points(depth, pose):
    """Return the point that each pixel sees, computed from the pinhole equations."""
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width].astype(float)
    x, y = (u - CAMERA.cx) / CAMERA.fx * depth, (v - CAMERA.cy) / CAMERA.fy * depth
    return np.stack([x, y, depth], axis=-1) @ pose[:3, :3].T + pose[:3, 3]


def test_depth_times_ray_lies_on_the_ball():
    depth, index = trace([BALL], camera_rays(CAMERA, POSE))
    seen = index == 0
    points = world_points(np.where(seen, depth, 0), POSE)[seen]
    assert len(points) > 50
    distance = np.linalg.norm(points - [0.2, 0.5, 1.1], axis=-1)
    np.testing.assert_allclose(distance, 0.4, atol=1e-9)


def test_depth_times_ray_lies_on_the_walls():
    depth, _ = trace([ROOM], camera_rays(CAMERA, POSE))
    points = world_points(depth, POSE)
    to_walls = np.abs(np.abs(points - [0, 0, 1.5]) - [3, 3, 1.5]).min(axis=-1)
    np.testing.assert_allclose(to_walls, 0, atol=1e-9)


def test_the_mask_is_where_the_ray_through_the_pixel_centre_meets_a_mover():
    # The distance of the ball's centre to each ray, by the cross product: no shared code.
    exposure = expose([ROOM], [[BALL]], [True], LAMP, POSE, CAMERA)
    rays = world_points(np.ones((60, 80)), POSE) - POSE[:3, 3]
    offset = np.array([0.2, 0.5, 1.1]) - POSE[:3, 3]
    distance = np.linalg.norm(np.cross(rays, offset), axis=-1) / np.linalg.norm(rays, axis=-1)
    np.testing.assert_array_equal(exposure.mover_mask, distance < 0.4)


def test_a_mover_that_does_not_count_is_seen_but_not_in_the_mask():
    both = [[BALL], [CRATE]]
    counted = expose([ROOM], both, [True, True], LAMP, POSE, CAMERA)
    only_ball = expose([ROOM], both, [True, False], LAMP, POSE, CAMERA)
    np.testing.assert_array_equal(counted.rgb, only_ball.rgb)
    np.testing.assert_array_equal(counted.depth, only_ball.depth)
    _, index = trace([ROOM, BALL, CRATE], camera_rays(CAMERA, POSE))
    np.testing.assert_array_equal(counted.mover_mask, index > 0)
    np.testing.assert_array_equal(only_ball.mover_mask, index == 1)


def test_what_is_nearer_hides_what_is_farther():
    depth, index = trace([ROOM, BALL, CRATE], camera_rays(CAMERA, POSE))
    single = [trace([part], camera_rays(CAMERA, POSE))[0] for part in (ROOM, BALL, CRATE)]
    np.testing.assert_array_equal(depth, np.min(single, axis=0))
    np.testing.assert_array_equal(index, np.argmin(single, axis=0))


@pytest.mark.parametrize("height", [0.3, 1.5, 2.6])
def test_looking_only_in_the_outline_of_a_part_misses_nothing(height):
    limb = Part(Capsule(0.2, 0.9), upright([0.1, -1.9, height], 0.3), plain(1, 1, 1))
    for part in (BALL, CRATE, limb):
        rays = camera_rays(CAMERA, POSE, supersample=2)
        everywhere = intersect_part(part, rays.origin, rays.directions.reshape(3, -1))
        depth, _ = trace([part], rays)
        np.testing.assert_array_equal(depth.reshape(-1), everywhere)


def test_things_behind_the_camera_are_not_seen():
    behind = Part(Box((0.5, 0.5, 0.5)), upright([0.3, -2.8, 1.5]), plain(1, 1, 1))
    assert not np.isfinite(trace([behind], camera_rays(CAMERA, POSE))[0]).any()


def test_a_wall_that_faces_the_lamp_has_the_colour_of_its_paint():
    # The floor straight below the lamp receives all of its light, at a right angle.
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 2.0
    exposure = expose([ROOM], [], [], LAMP, pose, CAMERA)
    brightest = exposure.rgb[29, 40]
    np.testing.assert_allclose(brightest, 0.5 * (AMBIENT + DIRECT), atol=2e-3)
    assert not exposure.mover_mask.any()


def test_a_ball_below_the_lamp_throws_a_round_shadow():
    # Lamp at 2.5 m, ball of radius 0.2 at 1.5 m: its rim is at asin(0.2 / 1.0) from the vertical.
    ball = Part(Ellipsoid((0.2, 0.2, 0.2)), upright([0, 0, 1.5]), plain(1, 0, 0))
    edge = 2.5 * np.tan(np.arcsin(0.2))
    across = np.linspace(-1, 1, 401, dtype=np.float32)
    floor = np.stack([across, np.zeros_like(across), np.zeros_like(across)])
    lit = lamp_visibility(floor, LAMP, [[ball]])
    expected = np.where(np.abs(across) < edge, 1 - SHADOW_DEPTH, 1.0)
    np.testing.assert_allclose(lit, expected)


def test_a_mover_behind_a_surface_throws_no_shadow_on_it():
    ball = Part(Ellipsoid((0.2, 0.2, 0.2)), upright([0, 0, 0.5]), plain(1, 0, 0))
    shelf = np.array([[0.0, 0.0, 1.5]], np.float32).T
    np.testing.assert_array_equal(lamp_visibility(shelf, LAMP, [[ball]]), [1.0])


def test_without_mask_and_shadow_the_static_view_is_the_moving_view():
    exposure = expose([ROOM, CRATE], [[BALL]], [True], LAMP, POSE, CAMERA)
    static = expose([ROOM, CRATE], [], [], LAMP, POSE, CAMERA)
    np.testing.assert_array_equal(exposure.static_rgb, static.rgb)
    points = world_points(static.depth, POSE).reshape(-1, 3).T.astype(np.float32)
    shadow = lamp_visibility(points, LAMP, [[BALL]]).reshape(60, 80) < 1
    assert shadow.any() and not (shadow & exposure.mover_mask).all()
    # The lens spreads each boundary by two pixels.
    touched = np.pad(shadow | exposure.mover_mask, 3)
    near = [np.roll(touched, (r, c), (0, 1)) for r in range(-3, 4) for c in range(-3, 4)]
    away = ~np.any(near, axis=0)[3:-3, 3:-3]
    assert away.mean() > 0.3
    np.testing.assert_array_equal(exposure.rgb[away], static.rgb[away])
    inside = shadow & ~exposure.mover_mask
    assert exposure.rgb[inside].mean() < static.rgb[inside].mean() - 0.02


def test_the_enclosing_sphere_encloses():
    centre, radius = enclosing_sphere([BALL, CRATE])
    for part in (BALL, CRATE):
        part_centre, part_radius = part.bounding_sphere()
        assert np.linalg.norm(part_centre - centre) + part_radius <= radius + 1e-12
