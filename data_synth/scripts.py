"""Who does what in each sequence.

A way is a list of marks (phase, across, away): when in the clip (0 to 1), where across the view of
the camera at that time (-1 and 1 are its edges), and how many metres away. Numbers such as hand
positions are choreography, found by looking at the result; tests hold how much they cover.
"""

import numpy as np

from . import surfaces
from .cast import TOWARDS_CAMERA, Cast, Mark, Mover
from .figures import (
    Arms,
    bag,
    ball,
    draw_robot,
    draw_table,
    part,
    quadruped,
    racket,
    table,
    umbrella,
)
from .motion import Route, curve
from .poses import upright
from .shapes import Ellipsoid, Part
from .textures import colour


def person_movers(cast: Cast) -> list[Mover]:
    """Return one person who comes close and passes."""
    way = ((0, 1.25, 2.5), (0.3, 0.65, 2.0), (0.55, 0.2, 1.55), (0.75, -0.15, 1.3), (1, -0.6, 1.5))
    return [Mover(cast.walker(cast.route(*way))[0])]


def crowd_movers(cast: Cast) -> list[Mover]:
    """Return four people, one with a bag, and a bouncing ball."""
    ways = (
        ((0, -1.2, 2.9), (0.35, -0.6, 2.4), (0.65, -0.1, 2.1), (1, 0.7, 2.1)),
        ((0, 1.8, 2.2), (0.4, 1.15, 1.8), (0.7, 0.45, 1.7), (1, -0.3, 1.65)),
        ((0, 0.6, 3.0), (0.4, 0.4, 2.6), (0.75, -0.35, 2.3), (1, -0.6, 2.4)),
    )
    movers = [Mover(cast.walker(cast.route(*way))[0]) for way in ways]
    hand = (0.05, -0.3, 0.78)
    carrier, body_at = cast.walker(
        cast.route((0, -2.2, 2.0), (0.45, -1.3, 1.7), (0.7, -0.7, 1.65), (1, -0.1, 1.75)),
        lambda phase: Arms(right=hand),
    )
    cover = cast.vivid()

    def with_bag(phase: float) -> list[Part]:
        body = body_at(phase)
        return carrier(phase) + bag(body.point(*hand), body, cover)

    thrown, radius = cast.vivid(), 0.15
    way = cast.route((0, 1.4, 2.2), (0.5, 0.7, 1.9), (1, -0.5, 1.5))

    def bouncing(phase: float) -> list[Part]:
        height = radius + 0.9 * abs(np.sin(2 * np.pi * 2.2 * phase))
        return [ball(np.array([*way.position(phase), height]), radius, 9 * phase, thrown)]

    return [*movers, Mover(with_bag), Mover(bouncing)]


def ball_movers(cast: Cast) -> list[Mover]:
    """Return a person who dribbles a large ball."""
    bounces, radius = 5.0, 0.22
    ball_place = (0.42, -0.14, 0.0)

    def reach(phase: float) -> Arms:
        return Arms(right=(0.34, -0.16, 0.92 + 0.2 * abs(np.sin(np.pi * bounces * phase))))

    way = ((0, 1.2, 2.3), (0.3, 0.7, 1.9), (0.55, 0.2, 1.5), (0.8, -0.3, 1.25), (1, -0.5, 1.3))
    dribbler, body_at = cast.walker(cast.route(*way), reach)
    cover = cast.vivid()

    def parts_at(phase: float) -> list[Part]:
        place = body_at(phase).point(*ball_place)
        place[2] = radius + 0.75 * abs(np.sin(np.pi * bounces * phase))
        return [*dribbler(phase), ball(place, radius, 14 * phase, cover)]

    return [Mover(parts_at)]


def racket_movers(cast: Cast) -> list[Mover]:
    """Return a person who swings a racket, and the ball in the air."""

    def grip(phase: float) -> tuple[float, float, float]:
        swing = np.sin(2 * np.pi * 3 * phase)
        return (0.42 + 0.1 * swing, -0.3 + 0.35 * swing, 1.2 + 0.25 * np.cos(6 * np.pi * phase))

    way = ((0, 0.9, 2.4), (0.35, 0.6, 2.0), (0.65, 0.15, 1.6), (1, -0.35, 1.5))
    player, body_at = cast.walker(cast.route(*way), lambda phase: Arms(right=grip(phase)))
    main, accent = cast.colours()
    face = surfaces.cloth(cast.rng, main, accent, "plaid", 0.48)
    handle = surfaces.patched(cast.rng, [accent, main], 0.25)
    cover = cast.vivid()
    court = cast.route((0, 0.0, 1.9), (0.5, 0.0, 1.6), (1, 0.0, 1.4))

    def parts_at(phase: float) -> list[Part]:
        body, hand = body_at(phase), np.array(grip(phase))
        end = body.point(*(hand + np.array([0.25, 0.1, 0.5])))
        return player(phase) + racket(body.point(*hand), end, face, handle)

    def flying(phase: float) -> list[Part]:
        swing = np.sin(2 * np.pi * 3 * phase - 0.8)
        x, y = court.position(phase)
        place = np.array([x + 0.7 * swing, y, 1.25 + 0.3 * np.cos(12 * np.pi * phase)])
        return [ball(place, 0.07, 20 * phase, cover)]

    return [Mover(parts_at), Mover(flying)]


def stones_movers(cast: Cast) -> list[Mover]:
    """Return a person who carries a stone, and a table with more of them that is pushed."""
    rng = cast.rng
    carry = Arms(left=(0.42, 0.16, 0.98), right=(0.42, -0.16, 0.98))
    way = ((0, 1.25, 2.3), (0.3, 0.9, 2.0), (0.65, 0.25, 1.7), (1, -0.2, 1.6))
    walker, body_at = cast.walker(cast.route(*way), lambda phase: carry)
    rock = surfaces.stone(rng, colour(rng.uniform(0.9, 1.0), 0.3, 0.55))
    skin = draw_table(rng, *cast.colours())
    pushed = cast.route((0, -0.8, 2.5), (0.4, -0.7, 2.3), (0.8, -0.45, 2.0), (1, -0.5, 2.0))

    def carried(phase: float) -> list[Part]:
        stone = part(Ellipsoid((0.2, 0.25, 0.17)), body_at(phase).placed(0.46, 0, 1.05), rock)
        return [*walker(phase), stone]

    def small_table(phase: float) -> list[Part]:
        place = upright(np.array([*pushed.position(phase), 0.0]), 0.25)
        heap = [part(Ellipsoid(radii), place @ upright(np.array(at)), rock) for radii, at in _HEAP]
        return table(place, skin, (0.8, 0.5, 0.5), 0.3) + heap

    return [Mover(carried), Mover(small_table)]


_HEAP = (  # radii and place of the stones on the table [m]
    ((0.14, 0.1, 0.09), (-0.1, -0.12, 0.6)),
    ((0.1, 0.1, 0.1), (0.2, 0.1, 0.6)),
)


def _carried_table(
    cast: Cast, way: tuple[Mark, ...], size: tuple[float, float, float]
) -> list[Mover]:
    """Return a table that stands, is carried between phases 0.3 and 0.75, and stands again."""
    rng = cast.rng
    skin = draw_table(rng, *cast.colours())
    # The table stands still at both ends, so its first and last marks are one place each.
    start, *between, end = (cast.on_floor(*mark) for mark in way)
    route = Route([(0, *start[1:]), start, *between, end, (1, *end[1:])])
    turn = rng.uniform(-0.15, 0.15)
    lift = curve((0, 0.0), (start[0], 0.0), (0.4, 0.09), (0.68, 0.09), (end[0], 0.0), (1, 0.0))
    yaw = curve((0, turn), (start[0], turn), (end[0], turn - 0.35), (1, turn - 0.35))

    def furniture_at(phase: float) -> list[Part]:
        place = upright(np.array([*route.position(phase), lift(phase)]), yaw(phase))
        return table(place, skin, size, 0.75)

    behind = 0.5 * size[1] + 0.3
    follow = [(p, x, y + behind) for p, x, y in ((0, *start[1:]), start, *between, end)]
    carrier_route = Route([*follow, (1, end[1] + 0.7, end[2] + behind + 0.6)], TOWARDS_CAMERA)
    grip = Arms(left=(0.34, 0.28, size[2] + 0.05), right=(0.34, -0.28, size[2] + 0.05))
    carrier, _ = cast.walker(carrier_route, lambda phase: grip)
    return [Mover(furniture_at), Mover(carrier)]


def table1_movers(cast: Cast) -> list[Mover]:
    """Return a table that is carried near and put down."""
    way = ((0.3, 0.9, 2.3), (0.5, 0.45, 1.85), (0.75, -0.1, 1.55))
    return _carried_table(cast, way, (1.1, 0.65, 0.78))


def table2_movers(cast: Cast) -> list[Mover]:
    """Return a large curtained table that is carried close to the camera."""
    way = ((0.2, 0.85, 2.1), (0.5, 0.3, 1.85), (0.75, -0.1, 1.72))
    return _carried_table(cast, way, (1.7, 0.8, 1.0))


def umbrella_movers(cast: Cast) -> list[Mover]:
    """Return a person who opens an umbrella towards the camera."""
    open_by = curve((0, 0.0), (0.35, 0.05), (0.6, 1.0), (1, 1.0))
    forward = curve((0, 0.1), (0.4, 0.1), (0.7, 0.75), (1, 0.5))
    side = curve((0, 0.1), (0.5, 0.2), (0.75, 0.0), (1, -0.35))
    hand = (0.36, -0.12, 1.15)
    way = ((0, 1.2, 2.4), (0.35, 0.8, 2.2), (0.68, 0.1, 1.95), (0.85, -0.5, 2.0), (1, -1.0, 2.1))
    walker, body_at = cast.walker(cast.route(*way), lambda phase: Arms(right=hand))
    main, accent = cast.colours()
    cover = surfaces.segments(cast.rng, main, accent, 1.4)
    stick = surfaces.stone(cast.rng, (0.3, 0.25, 0.25), 0.3)

    def parts_at(phase: float) -> list[Part]:
        grip = body_at(phase).point(*hand)
        # The dome is held towards the camera, which walks on the side of negative y.
        lean = np.array([side(phase), -forward(phase), 1.0 - 0.75 * forward(phase)])
        tip = grip + 0.85 * lean / np.linalg.norm(lean)
        return walker(phase) + umbrella(grip, tip, open_by(phase), cover, stick)

    return [Mover(parts_at)]


def _robot(cast: Cast, way: tuple[Mark, ...], size: float) -> list[Mover]:
    """Return a robot `size` times 0.9 m long."""
    route = cast.route(*way)
    skin = draw_robot(cast.rng, *cast.colours())
    return [Mover(lambda phase: quadruped(route, phase, skin, size))]


def anymal1_movers(cast: Cast) -> list[Mover]:
    """Return a four-legged robot that passes."""
    way = ((0, 1.2, 2.4), (0.3, 0.75, 2.0), (0.6, 0.15, 1.7), (0.8, -0.25, 1.6), (1, -0.7, 1.6))
    return _robot(cast, way, 1.3)


def anymal2_movers(cast: Cast) -> list[Mover]:
    """Return a smaller robot and the person who follows it."""
    robot_way = ((0, -1.1, 2.5), (0.35, -0.6, 2.0), (0.65, 0.1, 1.7), (1, 0.6, 1.7))
    owner_way = ((0, -1.4, 3.0), (0.4, -1.0, 2.6), (0.7, -0.5, 2.3), (1, 0.1, 2.3))
    robot = _robot(cast, robot_way, 1.2)
    return [*robot, Mover(cast.walker(cast.route(*owner_way))[0])]


def wandering_movers(cast: Cast) -> list[Mover]:
    """Return a person who stands in view, then walks towards the camera."""
    phase, x, y = cast.on_floor(0.6, 0.35, 1.9)
    leaving = [cast.on_floor(*mark) for mark in ((0.78, 0.0, 1.35), (1, -0.3, 1.15))]
    route = Route([(0, x, y), (phase, x, y), *leaving], TOWARDS_CAMERA)
    return [Mover(cast.walker(route)[0], moves_from=phase)]


def no_movers(cast: Cast) -> list[Mover]:
    """Return nobody."""
    return []
