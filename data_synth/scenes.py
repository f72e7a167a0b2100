"""The sequences: which room, who moves where, and how the camera walks.

The names follow the motion-capture sequences of Wild-SLAM, plus three of our own: `static`
(nothing moves), `lowtexture` (one person in a nearly bare room) and `wandering` (a person who
stands for most of the clip, then walks). Phases run from 0 to 1 over the clip of 100 frames.
"""

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from . import surfaces
from .errors import SynthError
from .figures import (
    STRIDE,
    Arms,
    Body,
    bag,
    ball,
    draw_outfit,
    draw_robot,
    draw_table,
    part,
    person,
    quadruped,
    racket,
    stand,
    table,
    umbrella,
)
from .motion import HandheldPath, Route, clip_phase, curve, handheld_path
from .poses import Array, upright
from .rooms import Room, living_room, workshop
from .shapes import Ellipsoid, Part
from .textures import Colour, colour

Motion = Callable[[float], list[Part]]  # phase -> parts in place


@dataclass(frozen=True)
class Mover:
    """Something that can move."""

    parts_at: Motion
    moves_from: float = 0.0  # phase before which it rests and does not count as moving


@dataclass(frozen=True)
class Scene:
    """A room, its movers and the walk of the camera; everything that `render_view` needs."""

    name: str
    seed: int
    room: Room
    movers: tuple[Mover, ...]
    path: HandheldPath

    def mover_parts(self, time: float) -> list[list[Part]]:
        """Return the parts of each mover at a time [s]."""
        phase = clip_phase(time)
        return [mover.parts_at(phase) for mover in self.movers]

    def counts_as_moving(self, time: float) -> list[bool]:
        """Return for each mover whether it belongs in the mask at a time [s]."""
        return [clip_phase(time) >= mover.moves_from for mover in self.movers]


class _Cast:
    """Draws movers; their colours come from hues that the furniture of the room leaves free."""

    def __init__(self, rng: np.random.Generator, hues: tuple[float, ...]):
        self.rng = rng
        self.hues = list(rng.permutation(hues))

    def colours(self) -> tuple[Colour, Colour]:
        """Return the main colour and an accent for the next mover."""
        hue = self.hues[0] + self.rng.uniform(-0.02, 0.02)
        self.hues = self.hues[1:] + self.hues[:1]
        main = colour(hue, self.rng.uniform(0.65, 0.85), self.rng.uniform(0.55, 0.85))
        return main, colour(hue + self.rng.uniform(0.3, 0.6), 0.45, 0.92)

    def route(self, *waypoints: tuple[float, float, float], facing: float = 0.0) -> Route:
        """Return a route with waypoints shifted a little, another way for every seed."""
        shift = self.rng.uniform(-0.06, 0.06, 2)
        return Route([(p, x + shift[0], y + shift[1]) for p, x, y in waypoints], facing)

    def walker(self, route: Route, arms: Callable[[float], Arms] | None = None):
        """Return the motion of a person, and a function that tells where the body is."""
        outfit = draw_outfit(self.rng, *self.colours())
        height = self.rng.uniform(1.64, 1.86)
        start = self.rng.uniform(0, 2 * np.pi)

        def body_at(phase: float) -> Body:
            return stand(route, phase, height)

        def parts_at(phase: float) -> list[Part]:
            swing = start + 2 * np.pi * route.walked(phase) / STRIDE
            held = arms(phase) if arms else Arms()
            return person(body_at(phase), outfit, swing, route.pace(phase), held)

        return parts_at, body_at

    def vivid(self):
        """Return a patched cover in the colours of the next mover."""
        main, accent = self.colours()
        return surfaces.patched(self.rng, [main, accent, (0.95, 0.95, 0.9)])


def _person(cast: _Cast) -> list[Mover]:
    route = cast.route(
        (0, 2.4, 0.9), (0.3, 1.0, 0.5), (0.55, -0.1, -0.1), (0.75, -0.75, -0.2), (1, -2.3, 0.4)
    )
    return [Mover(cast.walker(route)[0])]


def _crowd(cast: _Cast) -> list[Mover]:
    ways = (
        ((0, -2.3, 1.2), (0.35, -1.3, 0.6), (0.65, -0.2, 0.1), (1, 1.2, 0.0)),
        ((0, 2.5, 0.6), (0.3, 1.7, 0.3), (0.7, 0.5, -0.3), (1, -0.75, -0.3)),
        ((0, 1.1, 1.5), (0.4, 0.7, 0.7), (0.75, -0.4, 0.5), (1, -1.1, 0.9)),
    )
    movers = [Mover(cast.walker(cast.route(*way))[0]) for way in ways]
    hand = (0.05, -0.3, 0.78)
    carrier, body_at = cast.walker(
        cast.route((0, -2.6, 0.3), (0.4, -1.9, 0.0), (0.7, -0.9, -0.35), (1, 0.35, -0.5)),
        lambda phase: Arms(right=hand),
    )
    cover = cast.vivid()

    def with_bag(phase: float) -> list[Part]:
        body = body_at(phase)
        return carrier(phase) + bag(body.point(*hand), body, cover)

    thrown, radius = cast.vivid(), 0.15
    way = cast.route((0, 1.9, 0.2), (0.5, 1.0, -0.2), (1, -0.4, -0.55))

    def bouncing(phase: float) -> list[Part]:
        height = radius + 0.9 * abs(np.sin(2 * np.pi * 2.2 * phase))
        return [ball(np.array([*way.position(phase), height]), radius, 9 * phase, thrown)]

    return [*movers, Mover(with_bag), Mover(bouncing)]


def _ball(cast: _Cast) -> list[Mover]:
    bounces, radius = 5.0, 0.2

    def reach(phase: float) -> Arms:
        return Arms(right=(0.34, -0.16, 0.92 + 0.2 * abs(np.sin(np.pi * bounces * phase))))

    route = cast.route(
        (0, -2.2, 0.75), (0.35, -1.0, 0.4), (0.6, -0.1, -0.2), (0.8, 0.5, -0.4), (1, 0.95, -0.2)
    )
    dribbler, body_at = cast.walker(route, reach)
    cover = cast.vivid()

    def parts_at(phase: float) -> list[Part]:
        place = body_at(phase).point(0.42, -0.14, 0.0)
        place[2] = radius + 0.55 * abs(np.sin(np.pi * bounces * phase))
        return [*dribbler(phase), ball(place, radius, 14 * phase, cover)]

    return [Mover(parts_at)]


def _racket(cast: _Cast) -> list[Mover]:
    def grip(phase: float) -> tuple[float, float, float]:
        swing = np.sin(2 * np.pi * 3 * phase)
        return (0.42 + 0.1 * swing, -0.3 + 0.35 * swing, 1.2 + 0.25 * np.cos(6 * np.pi * phase))

    route = cast.route(
        (0, 1.5, 0.7), (0.3, 0.9, 0.5), (0.6, 0.0, 0.0), (1, -0.5, 0.15), facing=-1.9
    )
    player, body_at = cast.walker(route, lambda phase: Arms(right=grip(phase)))
    main, accent = cast.colours()
    face = surfaces.cloth(cast.rng, main, accent, "plaid", 0.48)
    handle = surfaces.patched(cast.rng, [accent, main], 0.25)
    cover = cast.vivid()

    def parts_at(phase: float) -> list[Part]:
        body, hand = body_at(phase), np.array(grip(phase))
        end = body.point(*(hand + np.array([0.25, 0.1, 0.5])))
        return player(phase) + racket(body.point(*hand), end, face, handle)

    def flying(phase: float) -> list[Part]:
        swing = np.sin(2 * np.pi * 3 * phase - 0.8)
        place = np.array([0.1 + 1.3 * swing, -0.15, 1.25 + 0.3 * np.cos(12 * np.pi * phase)])
        return [ball(place, 0.07, 20 * phase, cover)]

    return [Mover(parts_at), Mover(flying)]


def _stones(cast: _Cast) -> list[Mover]:
    rng = cast.rng
    carry = Arms(left=(0.42, 0.16, 0.98), right=(0.42, -0.16, 0.98))
    route = cast.route((0, 1.7, 0.5), (0.3, 1.2, 0.35), (0.65, 0.1, 0.1), (1, -0.55, 0.2))
    walker, body_at = cast.walker(route, lambda phase: carry)
    rock = surfaces.stone(rng, colour(rng.uniform(0.9, 1.0), 0.3, 0.55))
    skin = draw_table(rng, *cast.colours())
    table_x = curve((0, -0.95), (0.4, -0.9), (0.8, -0.4), (1, -0.3))
    shift = rng.uniform(-0.05, 0.05)

    def carried(phase: float) -> list[Part]:
        body = body_at(phase)
        stone = part(Ellipsoid((0.2, 0.25, 0.17)), body.placed(0.46, 0, 1.05), rock)
        return [*walker(phase), stone]

    def small_table(phase: float) -> list[Part]:
        place = upright(np.array([table_x(phase) + shift, 0.05, 0.0]), 0.25)
        heap = [part(Ellipsoid(radii), place @ upright(np.array(at)), rock) for radii, at in _HEAP]
        return table(place, skin, (0.8, 0.5, 0.5), 0.3) + heap

    return [Mover(carried), Mover(small_table)]


_HEAP = (
    ((0.14, 0.1, 0.09), (-0.1, -0.12, 0.6)),
    ((0.1, 0.1, 0.1), (0.2, 0.1, 0.6)),
)


def _carried_table(
    cast: _Cast, way: tuple[tuple[float, float, float], ...], size: tuple[float, float, float]
) -> list[Mover]:
    rng = cast.rng
    skin = draw_table(rng, *cast.colours())
    route = cast.route(*way)
    turn = rng.uniform(-0.15, 0.15)
    lift = curve((0, 0.0), (0.25, 0.0), (0.4, 0.09), (0.72, 0.09), (0.82, 0.0), (1, 0.0))
    yaw = curve((0, turn), (0.3, turn), (0.8, turn - 0.35), (1, turn - 0.35))

    def table_at(phase: float) -> Array:
        return upright(np.array([*route.position(phase), lift(phase)]), yaw(phase))

    def furniture_at(phase: float) -> list[Part]:
        return table(table_at(phase), skin, size, 0.75)

    behind = 0.5 * size[1] + 0.3
    carrier_route = Route([(p, x + 0.15, y + behind) for p, x, y in way], facing=-np.pi / 2)
    grip = Arms(left=(0.34, 0.28, size[2] + 0.05), right=(0.34, -0.28, size[2] + 0.05))
    carrier, _ = cast.walker(carrier_route, lambda phase: grip)
    return [Mover(furniture_at), Mover(carrier)]


def _table1(cast: _Cast) -> list[Mover]:
    rest = (-0.05, -0.3)
    way = ((0, 1.15, 0.6), (0.3, 1.1, 0.5), (0.72, 0.0, -0.25), (0.8, *rest), (1, *rest))
    return _carried_table(cast, way, (1.1, 0.65, 0.78))


def _table2(cast: _Cast) -> list[Mover]:
    rest = (-0.2, -0.4)
    way = ((0, 0.6, 0.0), (0.2, 0.55, 0.0), (0.72, -0.15, -0.4), (0.8, *rest), (1, *rest))
    return _carried_table(cast, way, (1.7, 0.8, 1.0))


def _umbrella(cast: _Cast) -> list[Mover]:
    open_by = curve((0, 0.0), (0.35, 0.05), (0.6, 1.0), (1, 1.0))
    forward = curve((0, 0.1), (0.4, 0.1), (0.7, 0.75), (1, 0.5))
    side = curve((0, 0.1), (0.5, 0.2), (0.75, 0.0), (1, -0.35))
    hand = (0.36, -0.12, 1.15)
    route = cast.route(
        (0, 1.9, 0.5), (0.35, 1.0, 0.35), (0.7, 0.1, -0.3), (1, -0.9, -0.1), facing=-1.57
    )
    walker, body_at = cast.walker(route, lambda phase: Arms(right=hand))
    main, accent = cast.colours()
    cover = surfaces.segments(cast.rng, main, accent, 1.4)
    stick = surfaces.stone(cast.rng, (0.3, 0.25, 0.25), 0.3)

    def parts_at(phase: float) -> list[Part]:
        body = body_at(phase)
        grip = body.point(*hand)
        # The dome is held towards the camera, which walks on the side of negative y.
        lean = np.array([side(phase), -forward(phase), 1.0 - 0.75 * forward(phase)])
        tip = grip + 0.85 * lean / np.linalg.norm(lean)
        return walker(phase) + umbrella(grip, tip, open_by(phase), cover, stick)

    return [Mover(parts_at)]


def _robot(cast: _Cast, way: tuple[tuple[float, float, float], ...], size: float) -> list[Mover]:
    route = cast.route(*way)
    skin = draw_robot(cast.rng, *cast.colours())
    return [Mover(lambda phase: quadruped(route, phase, skin, size))]


def _anymal1(cast: _Cast) -> list[Mover]:
    way = ((0, 1.9, 0.4), (0.3, 1.2, 0.1), (0.6, 0.1, -0.4), (0.8, -0.5, -0.45), (1, -1.1, -0.3))
    return _robot(cast, way, 1.3)


def _anymal2(cast: _Cast) -> list[Mover]:
    robot_way = ((0, -1.9, 0.6), (0.35, -0.9, -0.1), (0.65, 0.2, -0.4), (1, 1.0, -0.4))
    owner_way = ((0, -2.5, 1.2), (0.4, -1.7, 0.6), (0.7, -0.8, 0.4), (1, 0.1, 0.5))
    owner = cast.walker(cast.route(*owner_way))[0]
    return [*_robot(cast, robot_way, 1.2), Mover(owner)]


def _wandering(cast: _Cast) -> list[Mover]:
    route = cast.route(
        (0, 0.95, 0.35), (0.6, 0.95, 0.35), (0.8, 0.1, -0.1), (1, -1.0, -0.1), facing=-1.9
    )
    return [Mover(cast.walker(route)[0], moves_from=0.6)]


def _nobody(cast: _Cast) -> list[Mover]:
    return []


WARM_HUES = (0.0, 0.92, 0.83, 0.12, 0.97)  # movers in the cool room
COOL_HUES = (0.6, 0.68, 0.78, 0.87, 0.48)  # movers in the warm room


@dataclass(frozen=True)
class _Script:
    """What is particular to one sequence."""

    summary: str
    movers: Callable[[_Cast], list[Mover]]
    cool_room: bool = False
    low_texture: bool = False


_SCRIPTS: dict[str, _Script] = {
    "anymal1": _Script("a four-legged robot walks across", _anymal1),
    "anymal2": _Script("a four-legged robot and its owner", _anymal2, cool_room=True),
    "ball": _Script("a person dribbles a ball", _ball),
    "crowd": _Script("four people, a bag and a bouncing ball", _crowd, cool_room=True),
    "person": _Script("one person walks by, close to the camera", _person),
    "racket": _Script("a person swings a racket", _racket, cool_room=True),
    "stones": _Script("a person carries stones; a small table is moved", _stones),
    "table1": _Script("a table is carried, then rests", _table1, cool_room=True),
    "table2": _Script("a near table fills almost half the view (declared hard case)", _table2),
    "umbrella": _Script("an umbrella opens and sweeps across", _umbrella),
    "static": _Script("nothing moves", _nobody),
    "lowtexture": _Script("one person in a nearly bare room", _person, low_texture=True),
    "wandering": _Script("a person stands for most of the clip, then walks", _wandering, True),
}
SEQUENCES: tuple[str, ...] = tuple(_SCRIPTS)
SUMMARIES: dict[str, str] = {name: script.summary for name, script in _SCRIPTS.items()}


def scene(name: str, seed: int = 0) -> Scene:
    """Build the scene of a sequence; the same name and seed always build the same one."""
    if name not in _SCRIPTS:
        raise SynthError(f"no sequence is called {name!r}: choose one of {', '.join(SEQUENCES)}")
    if seed < 0:
        raise SynthError(f"a seed is a whole number from 0 on, not {seed}")
    script = _SCRIPTS[name]
    # A hash that Python does not change from run to run, so that each name has its own draws.
    rng = np.random.default_rng([zlib.crc32(name.encode()), seed])
    room_rng, mover_rng, path_rng = rng.spawn(3)
    furnish = workshop if script.cool_room else living_room
    room = furnish(room_rng, script.low_texture)
    hues = WARM_HUES if script.cool_room else COOL_HUES
    movers = tuple(script.movers(_Cast(mover_rng, hues)))
    path = handheld_path(path_rng, room.camera_centre, room.camera_target)
    return Scene(name, seed, room, movers, path)
