"""Things that move: people, a walking robot, and what people carry, as jointed solids."""

from dataclasses import dataclass

import numpy as np

from . import surfaces
from .motion import Route
from .poses import Array, frame_along, rigid, rotation_about_z, upright
from .shapes import Box, Capsule, Cylinder, Ellipsoid, Part, Shape
from .textures import Colour, Texture, colour

STRIDE = 1.4  # m walked per cycle of both legs
ROBOT_STRIDE = 0.55  # m


def part(shape: Shape, T_world_part: Array, texture: Texture) -> Part:
    """Return a part wrapped in one texture."""
    return Part(shape, T_world_part, (texture,))


@dataclass(frozen=True)
class Outfit:
    """The textures of one person."""

    shirt: Texture
    trousers: Texture
    skin: Texture
    hair: Texture
    shoes: Texture


def draw_outfit(rng: np.random.Generator, shirt: Colour, accent: Colour) -> Outfit:
    """Return an outfit with a given shirt; the rest is drawn."""
    pattern = rng.choice(["stripes", "plaid", "dots"])
    dark_hue = rng.uniform()
    trousers = colour(dark_hue, 0.35, rng.uniform(0.22, 0.42))
    skin = colour(0.06, rng.uniform(0.35, 0.55), rng.uniform(0.5, 0.9))
    hair = colour(0.07, 0.5, rng.uniform(0.1, 0.4))
    return Outfit(
        shirt=surfaces.cloth(rng, shirt, accent, pattern),
        trousers=surfaces.cloth(rng, trousers, accent, "plain"),
        skin=surfaces.cloth(rng, skin, skin, "plain", size=0.25),
        hair=surfaces.stone(rng, hair, size=0.25),
        shoes=surfaces.patched(rng, [colour(dark_hue + 0.4, 0.7, 0.6), (0.9, 0.9, 0.9)], 0.25),
    )


@dataclass(frozen=True)
class Body:
    """A person standing at a place: a frame to hang limbs and things on."""

    T_world_body: Array  # (4, 4): x forward, y left, z up, origin on the floor
    scale: float  # height / 1.75 m

    def point(self, forward: float, left: float, up: float) -> Array:
        """Return the world position of a place on the body, given for a height of 1.75 m."""
        local = self.scale * np.array([forward, left, up])
        return self.T_world_body[:3, :3] @ local + self.T_world_body[:3, 3]

    def placed(self, forward: float, left: float, up: float) -> Array:
        """Return T_world_part of a part with the orientation of the body."""
        return rigid(self.T_world_body[:3, :3], self.point(forward, left, up))

    def limb(self, start: Array, end: Array, radius: float, texture: Texture) -> Part:
        """Return a capsule between two joints."""
        length = float(np.linalg.norm(end - start))
        shape = Capsule(radius * self.scale, length)
        return part(shape, frame_along(start, end, self.T_world_body[:3, 0]), texture)


@dataclass(frozen=True)
class Arms:
    """Where the hands are, relative to the body (forward, left, up) [m]; None swings."""

    left: tuple[float, float, float] | None = None
    right: tuple[float, float, float] | None = None


def stand(route: Route, phase: float, height: float) -> Body:
    """Return the frame of a person on a route."""
    x, y = route.position(phase)
    bounce = 0.02 * np.cos(4 * np.pi * route.walked(phase) / STRIDE) * route.pace(phase)
    yaw = route.heading(phase)
    return Body(upright([x, y, bounce], yaw), height / 1.75)


def person(body: Body, outfit: Outfit, swing: float, pace: float, arms: Arms) -> list[Part]:
    """Return a person in mid-step: `swing` is the phase of the walk [rad]."""
    parts = [
        part(Ellipsoid(_scaled(body, 0.15, 0.2, 0.33)), body.placed(0, 0, 1.17), outfit.shirt),
        part(Ellipsoid(_scaled(body, 0.14, 0.185, 0.17)), body.placed(0, 0, 0.92), outfit.trousers),
        part(Ellipsoid(_scaled(body, 0.1, 0.085, 0.125)), body.placed(0.03, 0, 1.62), outfit.skin),
        part(
            Ellipsoid(_scaled(body, 0.11, 0.095, 0.12), -0.1),
            body.placed(0.005, 0, 1.655),
            outfit.hair,
        ),
        body.limb(body.point(0, 0, 1.4), body.point(0.01, 0, 1.54), 0.055, outfit.skin),
        body.limb(body.point(0, 0.15, 1.4), body.point(0, -0.15, 1.4), 0.075, outfit.shirt),
    ]
    for left, sign, hand in ((0.1, 1.0, arms.left), (-0.1, -1.0, arms.right)):
        parts += _leg(body, outfit, left, sign * np.sin(swing) * pace, swing, sign, pace)
        parts += _arm(body, outfit, sign, -sign * np.sin(swing) * pace, hand)
    return parts


def _scaled(body: Body, x: float, y: float, z: float) -> tuple[float, float, float]:
    return (x * body.scale, y * body.scale, z * body.scale)


def _leg(
    body: Body, outfit: Outfit, left: float, reach: float, swing: float, sign: float, pace: float
) -> list[Part]:
    """Return thigh, shin and shoe of a leg that reaches forward (-1 to 1)."""
    thigh_angle = 0.45 * reach
    bend = 0.1 + 0.75 * pace * max(0.0, float(sign * np.cos(swing)))
    hip = (0.0, left, 0.9)
    knee = (0.43 * np.sin(thigh_angle), left, 0.9 - 0.43 * np.cos(thigh_angle))
    shin_angle = thigh_angle - bend
    ankle = (knee[0] + 0.4 * np.sin(shin_angle), left, knee[2] - 0.4 * np.cos(shin_angle))
    shoe = body.placed(ankle[0] + 0.06, left, max(ankle[2] - 0.03, 0.05))
    return [
        body.limb(body.point(*hip), body.point(*knee), 0.082, outfit.trousers),
        body.limb(body.point(*knee), body.point(*ankle), 0.062, outfit.trousers),
        part(Box(_scaled(body, 0.27, 0.1, 0.09)), shoe, outfit.shoes),
    ]


def _arm(
    body: Body, outfit: Outfit, sign: float, reach: float, hand: tuple[float, float, float] | None
) -> list[Part]:
    """Return upper arm, forearm and hand, swinging or reaching for a place."""
    shoulder = np.array([0.0, 0.2 * sign, 1.4])
    if hand is None:
        angle = 0.5 * reach
        elbow = shoulder + np.array([0.28 * np.sin(angle), 0.05 * sign, -0.28 * np.cos(angle)])
        bent = angle + 0.4
        wrist = elbow + np.array([0.26 * np.sin(bent), 0.0, -0.26 * np.cos(bent)])
    else:
        wrist = np.array(hand)
        elbow = (shoulder + wrist) / 2 + [-0.03, 0.07 * sign, -0.1]
    palm = part(Ellipsoid(_scaled(body, 0.055, 0.055, 0.06)), body.placed(*wrist), outfit.skin)
    return [
        body.limb(body.point(*shoulder), body.point(*elbow), 0.055, outfit.shirt),
        body.limb(body.point(*elbow), body.point(*wrist), 0.042, outfit.skin),
        palm,
    ]


@dataclass(frozen=True)
class RobotSkin:
    """The textures of a walking robot."""

    shell: Texture
    joints: Texture
    head: Texture


def draw_robot(rng: np.random.Generator, main: Colour, accent: Colour) -> RobotSkin:
    """Return the covers of a four-legged robot."""
    return RobotSkin(
        shell=surfaces.patched(rng, [main, accent, (0.12, 0.12, 0.14), main], 0.8),
        joints=surfaces.stone(rng, (0.22, 0.22, 0.25), 0.3),
        head=surfaces.patched(rng, [(0.15, 0.15, 0.18), accent], 0.3),
    )


def quadruped(route: Route, phase: float, skin: RobotSkin, size: float) -> list[Part]:
    """Return a robot dog trotting along a route; `size` is its length / 0.9 m."""
    x, y = route.position(phase)
    swing = 2 * np.pi * route.walked(phase) / (ROBOT_STRIDE * size)
    body = Body(upright([x, y, 0.015 * np.cos(2 * swing)], route.heading(phase)), size)
    parts = [
        part(Box(_scaled(body, 0.78, 0.3, 0.24)), body.placed(0, 0, 0.6), skin.shell),
        part(Box(_scaled(body, 0.3, 0.2, 0.12)), body.placed(-0.05, 0, 0.78), skin.joints),
        part(Box(_scaled(body, 0.2, 0.2, 0.17)), body.placed(0.46, 0, 0.66), skin.head),
        part(Cylinder(0.05 * size, 0.2 * size), body.placed(0.15, 0, 0.82), skin.head),
    ]
    for forward, left, shift in ((0.3, 1, 0), (0.3, -1, np.pi), (-0.3, 1, np.pi), (-0.3, -1, 0)):
        step = swing + shift
        foot_lift = 0.09 * max(0.0, float(np.cos(step))) * route.pace(phase)
        foot_forward = forward + 0.13 * np.sin(step) * route.pace(phase)
        hip = body.point(forward, 0.2 * left, 0.58)
        knee = body.point((forward + foot_forward) / 2 - 0.14, 0.23 * left, 0.33)
        foot = body.point(foot_forward, 0.23 * left, 0.05 + foot_lift)
        parts.append(body.limb(hip, knee, 0.075, skin.shell))
        parts.append(body.limb(knee, foot, 0.045, skin.joints))
    return parts


@dataclass(frozen=True)
class TableSkin:
    """The textures of a table and what stands on it."""

    top: Texture
    legs: Texture
    load: Texture


def draw_table(rng: np.random.Generator, main: Colour, accent: Colour) -> TableSkin:
    """Return the covers of a table."""
    return TableSkin(
        top=surfaces.patched(rng, [main, accent, tuple(np.array(main) * 0.6)], 1.2),
        legs=surfaces.cloth(rng, tuple(np.array(main) * 0.5), accent, "stripes"),
        load=surfaces.patched(rng, [accent, colour(0.15, 0.6, 0.9), main], 0.5),
    )


def table(
    T_world_table: Array, skin: TableSkin, size: tuple[float, float, float], curtain: float
) -> list[Part]:
    """Return a table with panels that hang down by `curtain` times its height."""
    length, width, height = size
    parts = [_attached(T_world_table, Box((length, width, 0.05)), (0, 0, height), skin.top)]
    for x in (-0.46, 0.46):
        for y in (-0.44, 0.44):
            leg = Box((0.06, 0.06, height))
            place = (x * length, y * width, height / 2)
            parts.append(_attached(T_world_table, leg, place, skin.legs))
    drop = curtain * height
    for y in (-0.46, 0.46):
        panel = Box((0.86 * length, 0.03, drop))
        place = (0, y * width, height - drop / 2)
        parts.append(_attached(T_world_table, panel, place, skin.top))
    for x, side in ((-0.3, 0.32), (0.05, 0.22), (0.34, 0.27)):
        load = Box((0.8 * side, 0.8 * side, side))
        place = (x * length, 0.1 * width, height + side / 2 + 0.025)
        parts.append(_attached(T_world_table, load, place, skin.load))
    return parts


def _attached(
    T_world_thing: Array, shape: Shape, place: tuple[float, float, float], texture: Texture
) -> Part:
    return part(shape, T_world_thing @ upright(np.array(place, float)), texture)


def umbrella(
    grip: Array, tip: Array, openness: float, cover: Texture, stick: Texture
) -> list[Part]:
    """Return an umbrella from grip to tip that is open by 0 (a bundle) to 1 (a dome)."""
    side = np.array([0.0, 0.0, 1.0]) if abs((tip - grip)[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    T_world_stick = frame_along(grip, tip, side)
    length = float(np.linalg.norm(tip - grip))
    radius = 0.08 + 0.52 * openness
    height = 0.62 - 0.3 * openness
    T_stick_dome = upright([0.0, 0.0, length / 2 - height])
    return [
        part(Capsule(0.018, length), T_world_stick, stick),
        part(Ellipsoid((radius, radius, height), 0.0), T_world_stick @ T_stick_dome, cover),
    ]


def racket(grip: Array, end: Array, face: Texture, handle: Texture) -> list[Part]:
    """Return a racket with its face at the far end."""
    axis = (end - grip) / np.linalg.norm(end - grip)
    neck = grip + 0.22 * axis
    T_world_face = frame_along(neck, neck + 0.36 * axis, np.array([0.3, 0.8, 0.52]))
    return [
        part(Capsule(0.02, 0.22), frame_along(grip, neck, np.array([0.3, 0.8, 0.52])), handle),
        part(Ellipsoid((0.02, 0.15, 0.19)), T_world_face, face),
    ]


def ball(centre: Array, radius: float, roll: float, cover: Texture) -> Part:
    """Return a ball rolled by an angle [rad] about the vertical."""
    return part(Ellipsoid((radius,) * 3), rigid(rotation_about_z(roll), centre), cover)


def bag(hand: Array, body: Body, cover: Texture) -> list[Part]:
    """Return a bag hanging from a hand."""
    R = body.T_world_body[:3, :3]
    strap = frame_along(hand - [0, 0, 0.16], hand, R[:, 0])
    return [
        part(Capsule(0.02, 0.16), strap, cover),
        part(Box((0.4, 0.16, 0.32)), rigid(R, hand - [0, 0, 0.32]), cover),
    ]
