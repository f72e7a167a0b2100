"""Movers, and the stage directions that place them before a walking camera."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from . import surfaces
from .figures import STRIDE, Arms, Body, draw_outfit, person, stand
from .motion import CLIP_SECONDS, HandheldPath, Route
from .shapes import Part
from .textures import Colour, Texture, colour

Motion = Callable[[float], list[Part]]  # phase -> parts in place
# (phase, across the view in units of its half width, so that 1 is the edge, metres away)
Mark = tuple[float, float, float]
HALF_VIEW = 0.59  # tangent of half the horizontal view
TOWARDS_CAMERA = -np.pi / 2  # rad, heading towards the side of the room where the camera walks


@dataclass(frozen=True)
class Mover:
    """Something that can move."""

    parts_at: Motion
    # The phase before which it rests and stays out of the mask: nobody can yet know that it moves.
    # Static views leave it out at all times.
    moves_from: float = 0.0


class Cast:
    """Draws movers; their colours come from hues that the furniture of the room leaves free."""

    def __init__(self, rng: np.random.Generator, hues: tuple[float, ...], path: HandheldPath):
        self.rng = rng
        self.path = path
        self.hues = list(rng.permutation(hues))
        self.side = rng.choice([-1.0, 1.0])  # half of the seeds enter from the left

    def colours(self) -> tuple[Colour, Colour]:
        """Return the main colour and an accent for the next mover."""
        hue = self.hues[0] + self.rng.uniform(-0.02, 0.02)
        self.hues = self.hues[1:] + self.hues[:1]
        main = colour(hue, self.rng.uniform(0.65, 0.85), self.rng.uniform(0.55, 0.85))
        return main, colour(hue + self.rng.uniform(0.3, 0.6), 0.45, 0.92)

    def route(self, *marks: Mark, facing: float = TOWARDS_CAMERA) -> Route:
        """Return the way of a mover that crosses the view of the walking camera at given marks.

        Marks are set from where the camera will be, as for actors in a film: so every seed shows
        its movers as large as the script wants, however the camera walks.
        """
        shift = self.rng.uniform(-0.05, 0.05)
        return Route([self.on_floor(p, across + shift, away) for p, across, away in marks], facing)

    def on_floor(self, phase: float, across: float, away: float) -> tuple[float, float, float]:
        """Return (phase, x, y) of a mark."""
        T_world_camera = self.path(phase * CLIP_SECONDS)
        right, forward = T_world_camera[:2, 0], T_world_camera[:2, 2]
        forward = forward / np.linalg.norm(forward)
        offset = away * (forward + self.side * across * HALF_VIEW * right)
        return (phase, *(T_world_camera[:2, 3] + offset))

    def walker(
        self, route: Route, arms: Callable[[float], Arms] | None = None
    ) -> tuple[Motion, Callable[[float], Body]]:
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

    def vivid(self) -> Texture:
        """Return a patched cover in the colours of the next mover."""
        main, accent = self.colours()
        return surfaces.patched(self.rng, [main, accent, (0.95, 0.95, 0.9)])
