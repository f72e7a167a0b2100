"""Two furnished rooms of 6 x 5.2 x 2.8 m: everything that stays where it is."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from . import surfaces
from .poses import Array, upright
from .render import lamp_visibility
from .shapes import Box, Cylinder, Ellipsoid, Interior, Part, Shape
from .surfaces import Size
from .textures import Colour, Texture, build_texture, colour

LENGTH, WIDTH, HEIGHT = 6.0, 5.2, 2.8  # m, along x, y, z; the floor is z = 0
NORTH = WIDTH / 2  # y of the wall that the camera faces
EAST = LENGTH / 2
RUG_HEIGHT = 0.012  # m
SHADOW_CELL = 0.03  # m, resolution of the painted shadows of furniture
SHADOW_BLUR = 1.2  # cells, the width of their soft edges
STILL_SHADOW = 0.55  # how much the furniture's shadow takes away, of what a mover's shadow does
PLACE_JITTER, YAW_JITTER = 0.05, 0.12  # m, rad: no two seeds have the same furniture


@dataclass(frozen=True)
class Room:
    """The still world of a scene."""

    parts: tuple[Part, ...]
    lamp: Array  # (3,) [m]
    camera_centre: Array  # (3,) where a walk of the camera is centred
    camera_target: Array  # (3,) what it looks at


class _Builder:
    """Collects the parts of a room and draws what they are covered with."""

    def __init__(self, rng: np.random.Generator, palette: Sequence[Colour], covers: list[Texture]):
        self.rng, self.palette, self.covers = rng, palette, covers
        self.parts: list[Part] = []
        self.rugs: list[Part] = []

    def add(self, shape: Shape, T_world_part: Array, texture: Texture) -> None:
        """Place a shape."""
        self.parts.append(Part(shape, T_world_part, (texture,)))

    def rug(self, size: Size, place: tuple[float, float], yaw: float) -> None:
        """Spread a rug on the floor."""
        texture = surfaces.rug(self.rng, size, self.palette[1:])
        centre = upright([*place, RUG_HEIGHT / 2], yaw)
        self.rugs.append(Part(Box((*size, RUG_HEIGHT)), centre, (texture,)))

    def finished(self, shell: Part, lamp: Array) -> tuple[Part, ...]:
        """Return all parts, with the shadows of the furniture painted on floor and rugs."""
        *walls, floor = shell.textures
        floor = _shadowed(floor, upright([0.0, 0.0, 0.0]), lamp, self.parts)
        rugs = [
            replace(rug, textures=(_shadowed(rug.textures[0], rug.T_world_part, lamp, self.parts),))
            for rug in self.rugs
        ]
        return (replace(shell, textures=(*walls, floor)), *rugs, *self.parts)

    def cover(self) -> Texture:
        """Draw what the next piece of furniture is covered with."""
        return self.covers[self.rng.integers(len(self.covers))]

    def block(
        self, size: tuple[float, float, float], at: tuple[float, float], base: float = 0.0
    ) -> Array:  # (4, 4)
        """Put a block on the floor, or on something `base` metres high; return its frame."""
        jitter = self.rng.uniform(-PLACE_JITTER, PLACE_JITTER, 2)
        yaw = self.rng.uniform(-YAW_JITTER, YAW_JITTER)
        place = upright([at[0] + jitter[0], at[1] + jitter[1], base + size[2] / 2], yaw)
        self.add(Box(size), place, self.cover())
        return place

    def clutter(self, T_world_block: Array, size: tuple[float, float, float], count: int) -> None:
        """Put small things on top of a block."""
        for index in range(count):
            along = ((index + 0.5) / count - 0.5) * size[0] * 0.9
            across = self.rng.uniform(-0.25, 0.25) * size[1]
            height = self.rng.uniform(0.1, 0.34)
            width = min(self.rng.uniform(0.08, 0.2), 0.7 * size[0] / count)
            place = T_world_block @ upright([along, across, (size[2] + height) / 2])
            kind = self.rng.integers(3)
            if kind == 0:
                self.add(Cylinder(width / 2, height), place, self.cover())
            elif kind == 1:
                self.add(Box((width, width, height)), place, self.cover())
            else:
                self.add(Ellipsoid((width / 2, width / 2, height / 2)), place, self.cover())

    def picture(self, wall: str, along: float, up: float, size: tuple[float, float]) -> None:
        """Hang a framed picture on the "north", "east" or "west" wall."""
        thickness = 0.03
        texture = surfaces.poster(self.rng, size, self.palette)
        yaw, place = {
            "north": (0.0, [along, NORTH - thickness / 2, up]),
            "east": (np.pi / 2, [EAST - thickness / 2, along, up]),
            "west": (-np.pi / 2, [-EAST + thickness / 2, along, up]),
        }[wall]
        self.add(Box((size[0], thickness, size[1])), upright(np.array(place), yaw), texture)

    def plant(self, at: tuple[float, float], height: float) -> None:
        """Put a potted plant on the floor."""
        pot = surfaces.stone(self.rng, colour(0.05, 0.55, 0.6))
        leaves = surfaces.stone(self.rng, colour(0.3, 0.6, 0.42), 0.4)
        self.add(Cylinder(0.16, 0.32), upright([*at, 0.16]), pot)
        for _ in range(7):
            offset = self.rng.uniform((-0.16, -0.16, 0.45), (0.16, 0.16, height))
            radii = tuple(self.rng.uniform(0.08, 0.17, 3))
            yaw = self.rng.uniform(0, np.pi)
            place = upright(np.array([*at, 0.0]) + offset, yaw)
            self.add(Ellipsoid(radii), place, leaves)


def _shadowed(
    texture: Texture, T_world_surface: Array, lamp: Array, casters: Sequence[Part]
) -> Texture:
    """Darken a level surface where furniture keeps the lamp's light away.

    Lamp and furniture never move, so this is done once, coarsely, and blurred: soft shadows for
    next to nothing, where `lamp_visibility` has only to follow the movers.
    """
    rows, columns = texture.levels[0].shape[:2]
    count_up = round(rows * texture.texel / SHADOW_CELL)
    count_across = round(columns * texture.texel / SHADOW_CELL)
    row, column = np.mgrid[0:count_up, 0:count_across]
    local = np.zeros((4, row.size), np.float32)
    local[0] = (column.ravel() - (count_across - 1) / 2) * SHADOW_CELL
    local[1] = ((count_up - 1) / 2 - row.ravel()) * SHADOW_CELL
    local[3] = 1
    points = (T_world_surface.astype(np.float32) @ local)[:3]
    lit = lamp_visibility(points, lamp, [[part] for part in casters]).reshape(row.shape)
    lit = cv2.resize(cv2.GaussianBlur(lit, (0, 0), SHADOW_BLUR), (columns, rows))
    shade = 1 - STILL_SHADOW * (1 - lit)
    return build_texture(texture.levels[0] * shade[..., None], texture.texel)


def _shell(
    rng: np.random.Generator, palette: Sequence[Colour], floor: Colour, low_texture: bool
) -> Part:
    """Return the walls, floor and ceiling."""
    long_wall, short_wall = (LENGTH, HEIGHT), (WIDTH, HEIGHT)
    if low_texture:
        paint = colour(0.12, 0.08, 0.8)
        walls = [surfaces.plaster(rng, size, paint) for size in (short_wall, long_wall)]
        walls = [walls[0], walls[0], walls[1], walls[1]]
        ground = surfaces.plaster(rng, (LENGTH, WIDTH), colour(0.09, 0.15, 0.55))
    else:
        east_west = surfaces.wallpaper(rng, short_wall, palette)
        north = surfaces.wallpaper(rng, long_wall, palette)
        # The south wall is behind the camera: it has the paper of the north wall.
        walls = [east_west, east_west, north, north]
        ground = surfaces.planks(rng, (LENGTH, WIDTH), floor)
    ceiling = surfaces.planks(rng, (1.5, 1.5), colour(0.1, 0.05, 0.85), width=0.3)
    shape = Interior((LENGTH, WIDTH, HEIGHT))
    return Part(shape, upright([0.0, 0.0, HEIGHT / 2]), (*walls, ceiling, ground))


def living_room(rng: np.random.Generator, low_texture: bool = False) -> Room:
    """Furnish the warm room: shelves, a sofa, a low table, a sideboard."""
    hue = 0.08 + rng.uniform(-0.02, 0.03)
    palette = [
        colour(hue, 0.28, 0.82),
        colour(hue - 0.05, 0.5, 0.62),
        colour(hue + 0.04, 0.45, 0.72),
        colour(hue + 0.22, 0.3, 0.5),
        colour(hue, 0.55, 0.36),
        colour(hue + 0.02, 0.12, 0.95),
    ]
    floor = colour(hue - 0.01, 0.5, 0.55)
    if low_texture:
        covers = [surfaces.plaster(rng, (0.8, 0.8), tone) for tone in palette[:5]]
    else:
        covers = [surfaces.furniture(rng, tone) for tone in palette[:5]]
    build = _Builder(rng, palette, covers)
    shell = _shell(rng, palette, floor, low_texture)
    shelf = surfaces.books(rng, (1.4, 1.95), palette)
    build.add(Box((1.4, 0.34, 1.95)), upright([-1.75, NORTH - 0.17, 0.975]), shelf)
    sideboard = (1.5, 0.45, 0.78)
    build.clutter(build.block(sideboard, (1.45, NORTH - 0.35)), sideboard, 6)
    sofa = colour(hue + 0.3, 0.35, 0.5)
    fabric = surfaces.cloth(rng, sofa, tuple(np.array(sofa) * 1.35), "plaid")
    for cushion, place in _SOFA:
        build.add(Box(cushion), upright(place), fabric)
    low_table = (0.9, 0.5, 0.36)
    build.clutter(build.block(low_table, (0.25, 1.0)), low_table, 4)
    build.rug((2.2, 1.5), (0.2, 0.9), 0.1)
    for stool, at in (((0.42, 0.42, 0.46), (-1.15, 0.35)), ((0.5, 0.4, 0.62), (1.85, 0.75))):
        build.clutter(build.block(stool, at), stool, 2)
    tower = build.block((0.45, 0.4, 0.5), (2.45, 1.55))
    build.add(Box((0.34, 0.3, 0.4)), tower @ upright([0.02, 0, 0.45], 0.3), build.cover())
    build.plant((-2.55, 1.35), 1.25)
    build.plant((2.6, 2.2), 1.5)
    for wall, along, up, size in _LIVING_ROOM_PICTURES[: 2 if low_texture else None]:
        build.picture(wall, along, up, size)
    lamp = np.array([0.7, -0.9, 2.65])
    return Room(
        parts=build.finished(shell, lamp),
        lamp=lamp,
        camera_centre=np.array([0.0, -1.75, 1.42]),
        camera_target=np.array([0.05, 1.05, 0.95]),
    )


_SOFA = (
    ((1.5, 0.7, 0.42), (-0.05, NORTH - 0.5, 0.21)),
    ((1.5, 0.2, 0.85), (-0.05, NORTH - 0.2, 0.425)),
    ((0.18, 0.75, 0.6), (-0.85, NORTH - 0.5, 0.3)),
    ((0.18, 0.75, 0.6), (0.75, NORTH - 0.5, 0.3)),
)
_LIVING_ROOM_PICTURES = (
    ("north", 0.1, 1.65, (0.9, 0.62)),
    ("north", 1.35, 1.75, (0.55, 0.75)),
    ("north", 2.2, 1.6, (0.5, 0.5)),
    ("west", 0.9, 1.55, (0.95, 0.7)),
    ("west", -0.4, 1.6, (0.6, 0.8)),
    ("east", 0.7, 1.6, (0.8, 0.9)),
    ("east", -0.5, 1.5, (0.9, 0.6)),
)


def bare_room(rng: np.random.Generator) -> Room:
    """Furnish the warm room in plain colours: little for a tracker to hold on to."""
    return living_room(rng, low_texture=True)


def workshop(rng: np.random.Generator) -> Room:
    """Furnish the cool room: a bench, crates, barrels, a cupboard, a pin board."""
    hue = 0.53 + rng.uniform(-0.03, 0.03)
    palette = [
        colour(hue, 0.16, 0.74),
        colour(hue + 0.06, 0.38, 0.55),
        colour(hue - 0.18, 0.32, 0.6),
        colour(hue - 0.38, 0.35, 0.72),
        colour(hue + 0.03, 0.45, 0.34),
        colour(hue, 0.05, 0.95),
    ]
    build = _Builder(rng, palette, [surfaces.furniture(rng, tone) for tone in palette[:5]])
    shell = _shell(rng, palette, colour(hue + 0.05, 0.15, 0.45), low_texture=False)
    bench_top, y = (2.2, 0.62, 0.06), NORTH - 0.36
    bench = upright([-0.6, y, 0.82])
    build.add(Box(bench_top), bench, build.cover())
    build.clutter(bench, bench_top, 9)
    for x in (-1.62, -0.6, 0.42):
        build.add(Box((0.08, 0.55, 0.8)), upright([x, y, 0.4]), build.cover())
    build.block((0.7, 0.4, 0.45), (-1.1, y + 0.05))
    build.block((0.55, 0.4, 0.55), (-0.1, y + 0.05))
    shelf = surfaces.books(rng, (1.1, 2.05), palette)
    build.add(Box((1.1, 0.4, 2.05)), upright([1.45, NORTH - 0.2, 1.025]), shelf)
    for x, y, base in ((2.35, 1.9, 0), (2.3, 1.25, 0), (2.35, 1.6, 0.5), (-2.5, 1.7, 0)):
        build.block((0.55, 0.5, 0.5), (x, y), base)
    build.block((0.42, 0.36, 0.38), (-2.5, 1.72), 0.5)
    barrel = surfaces.planks(rng, (1.2, 0.9), palette[3], width=0.09)
    for x, y in ((-1.75, 1.0), (0.55, 1.35)):
        build.add(Cylinder(0.26, 0.78), upright([x, y, 0.39]), barrel)
        build.add(Ellipsoid((0.14, 0.14, 0.12)), upright([x, y, 0.9]), build.cover())
    cart = (0.85, 0.5, 0.5)
    build.clutter(build.block(cart, (-0.6, 0.9)), cart, 4)
    stool = (0.36, 0.36, 0.45)
    build.clutter(build.block(stool, (1.5, 0.45)), stool, 1)
    build.rug((1.8, 1.2), (0.3, 0.6), -0.15)
    for wall, along, up, size in _WORKSHOP_PICTURES:
        build.picture(wall, along, up, size)
    lamp = np.array([-0.6, -0.8, 2.6])
    return Room(
        parts=build.finished(shell, lamp),
        lamp=lamp,
        camera_centre=np.array([0.0, -1.7, 1.45]),
        camera_target=np.array([-0.05, 1.1, 0.95]),
    )


_WORKSHOP_PICTURES = (
    ("north", -0.75, 1.72, (1.6, 0.75)),
    ("north", 2.45, 1.75, (0.5, 0.7)),
    ("north", -2.2, 1.5, (0.7, 0.9)),
    ("west", 0.8, 1.6, (1.1, 0.8)),
    ("west", -0.5, 1.5, (0.7, 0.9)),
    ("east", 0.6, 1.75, (0.9, 0.7)),
    ("east", -0.6, 1.55, (0.8, 0.8)),
)
