"""Ray intersections against a second, blunt computation: march along the ray, then bisect."""

import numpy as np
import pytest

from data_synth.shapes import Box, Capsule, Cylinder, Ellipsoid, Interior

STEPS, REACH = 1500, 9.0  # samples along a ray and its length [m]


def inside_box(p, size):
    return (np.abs(p) < np.array(size)[:, None, None] / 2).all(axis=0)


def inside_ellipsoid(p, radii):
    return ((p / np.array(radii)[:, None, None]) ** 2).sum(axis=0) < 1


def inside_cylinder(p, radius, height):
    return (np.hypot(p[0], p[1]) < radius) & (np.abs(p[2]) < height / 2)


def inside_capsule(p, radius, length):
    nearest = np.clip(p[2], -length / 2, length / 2)
    return p[0] ** 2 + p[1] ** 2 + (p[2] - nearest) ** 2 < radius**2


SOLIDS = {
    "box": (Box((0.8, 0.5, 1.1)), lambda p: inside_box(p, (0.8, 0.5, 1.1))),
    "ball": (Ellipsoid((0.5, 0.5, 0.5)), lambda p: inside_ellipsoid(p, (0.5, 0.5, 0.5))),
    "ellipsoid": (Ellipsoid((0.3, 0.7, 0.5)), lambda p: inside_ellipsoid(p, (0.3, 0.7, 0.5))),
    "cylinder": (Cylinder(0.4, 0.9), lambda p: inside_cylinder(p, 0.4, 0.9)),
    "capsule": (Capsule(0.3, 0.8), lambda p: inside_capsule(p, 0.3, 0.8)),
}


def random_rays(seed, count=400):
    rng = np.random.default_rng(seed)
    origin = rng.normal(size=3)
    origin *= 2.5 / np.linalg.norm(origin)
    aims = rng.uniform(-0.7, 0.7, (3, count))
    return origin, (aims - origin[:, None]) / 2.5


def first_entry(inside, origin, directions):
    """Return the ray parameters at which rays enter a solid, by sampling and bisection."""

    def at(t):  # (S, N) -> bool (S, N)
        return inside(origin[:, None, None] + t * directions[:, None, :])

    samples = np.linspace(0, REACH, STEPS)[:, None] * np.ones(directions.shape[1])
    found = at(samples)
    first = found.argmax(axis=0)
    columns = np.arange(directions.shape[1])
    outer, inner = samples[np.maximum(first - 1, 0), columns], samples[first, columns]
    for _ in range(50):
        middle = (outer + inner) / 2
        is_inside = at(middle[None])[0]
        outer, inner = np.where(is_inside, outer, middle), np.where(is_inside, middle, inner)
    return np.where(found.any(axis=0), inner, np.inf)


@pytest.mark.parametrize("name", SOLIDS)
def test_marching_and_bisection_find_the_same_surface(name):
    shape, inside = SOLIDS[name]
    for seed in range(3):
        origin, directions = random_rays(seed)
        expected = first_entry(inside, origin, directions)
        actual = shape.intersect(origin, directions)
        seen = np.isfinite(expected)
        assert seen.sum() > 40
        np.testing.assert_allclose(actual[seen], expected[seen], atol=1e-6)
        # The march can step over a ray that grazes the solid; nothing more may be missing.
        assert np.isfinite(actual[~seen]).sum() <= 6


@pytest.mark.parametrize("name", SOLIDS)
def test_single_precision_agrees_with_double(name):
    shape, _ = SOLIDS[name]
    origin, directions = random_rays(7)
    exact = shape.intersect(origin, directions)
    single = shape.intersect(origin.astype(np.float32), directions.astype(np.float32))
    assert single.dtype == np.float32
    both = np.isfinite(exact) & np.isfinite(single)
    assert (np.isfinite(exact) != np.isfinite(single)).sum() <= 2
    np.testing.assert_allclose(single[both], exact[both], atol=2e-3)
    assert np.median(np.abs(single[both] - exact[both])) < 1e-6


@pytest.mark.parametrize("name", SOLIDS)
def test_normals_are_unit_and_point_out_of_the_solid(name):
    shape, inside = SOLIDS[name]
    origin, directions = random_rays(3)
    hit = shape.intersect(origin, directions)
    seen = np.isfinite(hit)
    points = origin[:, None] + hit[seen] * directions[:, seen]
    normals = shape.normals(points)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=0), 1.0, atol=1e-12)
    step = 1e-4 * normals
    assert inside((points - step)[:, None])[0].mean() > 0.98
    assert not inside((points + step)[:, None])[0].any()


def test_a_ball_is_met_at_distance_minus_radius():
    hit = Ellipsoid((0.5, 0.5, 0.5)).intersect(np.array([0, 0, -3.0]), np.array([[0.0, 0, 1]]).T)
    assert hit == pytest.approx(2.5)


def test_a_room_is_seen_from_inside():
    # From 1 m right of the middle of a room 6 m long: the right wall is 2 m away, the left one 4 m.
    room = Interior((6.0, 5.0, 3.0))
    rays = np.array([[1.0, 0, 0], [-1.0, 0, 0]]).T
    np.testing.assert_allclose(room.intersect(np.array([1.0, 0, 0]), rays), [2.0, 4.0])
    np.testing.assert_allclose(room.normals(np.array([[3.0, 0, 0]]).T)[:, 0], [-1, 0, 0])


def test_the_inside_of_a_dome_is_seen_from_below():
    dome = Ellipsoid((1.0, 1.0, 1.0), lowest=0.0)
    up, down = np.array([[0.0, 0, 1]]).T, np.array([[0.0, 0, -1]]).T
    assert dome.intersect(np.array([0, 0, -2.0]), up) == pytest.approx(3.0)
    assert dome.intersect(np.array([0, 0, 2.0]), down) == pytest.approx(1.0)
    assert np.isinf(dome.intersect(np.array([-3.0, 0, -0.5]), np.array([[1.0, 0, 0]]).T))


@pytest.mark.parametrize("name", SOLIDS)
def test_rays_that_start_inside_or_look_away_miss(name):
    shape, _ = SOLIDS[name]
    assert np.isinf(shape.intersect(np.zeros(3), np.array([[0.3, 0.2, 1.0]]).T)).all()
    assert np.isinf(shape.intersect(np.array([3.0, 0, 0]), np.array([[1.0, 0, 0]]).T)).all()


@pytest.mark.parametrize("name", SOLIDS)
def test_rays_parallel_to_an_axis_give_finite_answers(name):
    shape, _ = SOLIDS[name]
    hit = shape.intersect(np.array([0.05, 0.02, 4.0]), np.array([[0.0, 0, -1]]).T)
    assert np.isfinite(hit).all()
