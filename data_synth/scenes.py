"""The sequences: which room, who moves, and how the camera walks.

The names follow the motion-capture sequences of Wild-SLAM, plus four of our own: `static`
(nothing moves), `lowtexture` (one person in a nearly bare room), `wandering` (a person who stands
for most of the clip, then walks) and `loop` (nothing moves; the camera walks once around the room,
400 frames, and ends where it began).
"""

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from . import scripts
from .cast import Cast, Mover
from .errors import SynthError
from .motion import (
    CLIP_FRAMES,
    ROUND_FRAMES,
    HandheldPath,
    RoundPath,
    clip_phase,
    handheld_path,
    round_path,
)
from .rooms import Room, bare_room, living_room, workshop
from .shapes import Part


@dataclass(frozen=True)
class Scene:
    """A room, its movers and the walk of the camera; everything that `render_view` needs."""

    name: str
    seed: int
    room: Room
    movers: tuple[Mover, ...]
    path: HandheldPath | RoundPath

    def mover_parts(self, time: float) -> list[list[Part]]:
        """Return the parts of each mover at a time [s]."""
        phase = clip_phase(time)
        return [mover.parts_at(phase) for mover in self.movers]

    def counts_as_moving(self, time: float) -> list[bool]:
        """Return for each mover whether it belongs in the mask at a time [s]."""
        return [clip_phase(time) >= mover.moves_from for mover in self.movers]


_MIDDLE = np.array([0.0, -0.95, 1.42])  # m, of the floor that the furniture leaves free
WARM_HUES = (0.0, 0.92, 0.83, 0.12, 0.97)  # movers in the cool room
COOL_HUES = (0.6, 0.68, 0.78, 0.87, 0.48)  # movers in the warm room


@dataclass(frozen=True)
class _Script:
    """What is particular to one sequence."""

    summary: str
    movers: Callable[[Cast], list[Mover]]
    furnish: Callable[[np.random.Generator], Room] = living_room
    round_trip: bool = False  # the camera walks around the room


_SCRIPTS: dict[str, _Script] = {
    "anymal1": _Script("a four-legged robot walks across", scripts.anymal1_movers),
    "anymal2": _Script("a four-legged robot and its owner", scripts.anymal2_movers, workshop),
    "ball": _Script("a person dribbles a ball", scripts.ball_movers),
    "crowd": _Script("four people, a bag and a bouncing ball", scripts.crowd_movers, workshop),
    "person": _Script("one person walks by, close to the camera", scripts.person_movers),
    "racket": _Script("a person swings a racket", scripts.racket_movers, workshop),
    "stones": _Script("a person carries stones; a table is pushed", scripts.stones_movers),
    "table1": _Script("a table is carried, then rests", scripts.table1_movers, workshop),
    "table2": _Script("a near table fills half the view (hard case)", scripts.table2_movers),
    "umbrella": _Script("an umbrella opens and sweeps across", scripts.umbrella_movers),
    "static": _Script("nothing moves", scripts.no_movers),
    "lowtexture": _Script("one person, a nearly bare room", scripts.person_movers, bare_room),
    "wandering": _Script("a person stands, then walks", scripts.wandering_movers, workshop),
    "loop": _Script("nothing moves; once around the room", scripts.no_movers, round_trip=True),
}
SEQUENCES: tuple[str, ...] = tuple(_SCRIPTS)
SUMMARIES: dict[str, str] = {name: script.summary for name, script in _SCRIPTS.items()}


def default_frames(name: str) -> int:
    """Return the number of frames that tells the whole story of a sequence."""
    script = _SCRIPTS.get(name)
    return ROUND_FRAMES + 40 if script and script.round_trip else CLIP_FRAMES


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
    room = script.furnish(room_rng)
    hues = WARM_HUES if script.furnish is workshop else COOL_HUES
    if script.round_trip:
        return Scene(name, seed, room, (), round_path(path_rng, _MIDDLE))
    path = handheld_path(path_rng, room.camera_centre, room.camera_target)
    movers = tuple(script.movers(Cast(mover_rng, hues, path)))
    return Scene(name, seed, room, movers, path)
