"""Where things are at a time: routes through waypoints, and the hand-held camera."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from .poses import Array, look_at, rigid

FRAME_RATE = 30.0  # Hz
CLIP_FRAMES = 100  # frames of the choreography; longer sequences play it forth and back
CLIP_SECONDS = (CLIP_FRAMES - 1) / FRAME_RATE
ROUND_FRAMES = 360  # frames of one walk around a room
ROUND_SECONDS = ROUND_FRAMES / FRAME_RATE
EVENNESS = 0.95  # of the camera's speed: 0 swings like a pendulum, 1 turns back abruptly
PATH_SAMPLES = 200  # per clip, for lengths of paths


def clip_phase(time: float) -> float:
    """Return the place in the choreography, 0 at its start and 1 at its end, of a time [s]."""
    turns = time / CLIP_SECONDS
    return 1.0 - abs(turns % 2.0 - 1.0)


class Route:
    """A smooth way through waypoints on the floor, with heading and distance walked."""

    def __init__(self, waypoints: list[tuple[float, float, float]], facing: float = 0.0):
        """Take rows (phase in [0, 1], x, y) and the heading [rad] shown while standing."""
        table = np.array(waypoints, float)
        self._position = PchipInterpolator(table[:, 0], table[:, 1:])
        self._velocity = self._position.derivative()
        self._facing = np.array([np.cos(facing), np.sin(facing)])
        self._phases = np.linspace(0, 1, PATH_SAMPLES)
        steps = np.linalg.norm(np.diff(self._position(self._phases), axis=0), axis=1)
        self._walked = np.concatenate([[0.0], np.cumsum(steps)])

    def position(self, phase: float) -> Array:
        """Return the place (x, y) [m]."""
        return self._position(phase)

    def heading(self, phase: float) -> float:
        """Return the direction of walking [rad]; at rest, the direction faced."""
        # Adding a slow walk in the facing direction turns the walker smoothly when it stops.
        slow_walk = 0.6  # m per clip
        direction = self._velocity(phase) + slow_walk * self._facing
        return float(np.arctan2(direction[1], direction[0]))

    def walked(self, phase: float) -> float:
        """Return the distance walked since the start [m]."""
        return float(np.interp(phase, self._phases, self._walked))

    def pace(self, phase: float) -> float:
        """Return how fully the legs swing: 0 at rest, 1 in a walk."""
        walking_speed = 1.2  # m per clip
        return min(1.0, float(np.linalg.norm(self._velocity(phase))) / walking_speed)


def curve(*points: tuple[float, float]) -> Callable[[float], float]:
    """Return a smooth function of the phase through (phase, value) points."""
    table = np.array(points, float)
    interpolate = PchipInterpolator(table[:, 0], table[:, 1])
    return lambda phase: float(interpolate(phase))


@dataclass(frozen=True)
class HandheldPath:
    """A trembling walk that swings along each axis at a rate of its own and looks at the scene."""

    centre: Array  # (3,) [m]
    reach: Array  # (3,) amplitude per axis [m]
    cycles: Array  # (3,) swings per clip
    phases: Array  # (3,) [rad]
    target: Array  # (3,) [m]
    target_reach: Array  # (3,) [m]
    follow: float  # part of the camera's swing that is added to its target; < 0: it turns more
    tremble: Array  # (6, 4): amplitude [m, rad], frequency [Hz], phase [rad], second phase [rad]

    def __call__(self, time: float) -> Array:
        """Return T_world_camera (4, 4) at a time [s]."""
        angle = 2 * np.pi * self.cycles * time / CLIP_SECONDS + self.phases
        swing = self.reach * np.arcsin(EVENNESS * np.sin(angle)) / np.arcsin(EVENNESS)
        position = self.centre + swing
        target = self.target + self.target_reach * np.sin(0.7 * angle + 1.0)
        target = target + self.follow * swing
        shake = _shake(self.tremble, time)
        T_world_level = look_at(position + shake[:3], target)
        return T_world_level @ rigid(Rotation.from_rotvec(shake[3:]).as_matrix(), np.zeros(3))


@dataclass(frozen=True)
class RoundPath:
    """A walk around the middle of a room, looking across it, that comes back to its start."""

    centre: Array  # (3,) [m]
    reach: Array  # (3,) radii on the floor, and the amplitude of the height [m]
    start: float  # direction of the first place from the centre [rad]
    turn: float  # +1 or -1, the sense of the walk
    look_down: float  # m, how far below the camera the point is that it looks at
    tremble: Array  # (6, 4) as of a HandheldPath

    def __call__(self, time: float) -> Array:
        """Return T_world_camera (4, 4) at a time [s]."""
        angle = self.start + self.turn * 2 * np.pi * time / ROUND_SECONDS
        swing = self.reach * np.array([np.cos(angle), np.sin(angle), np.sin(3 * angle)])
        shake = _shake(self.tremble, time)
        across = self.centre - [0.0, 0.0, self.look_down]
        T_world_level = look_at(self.centre + swing + shake[:3], across)
        return T_world_level @ rigid(Rotation.from_rotvec(shake[3:]).as_matrix(), np.zeros(3))


def _shake(tremble: Array, time: float) -> Array:  # (6,) [m, rad]
    amplitude, frequency, first, second = tremble.T
    shake = np.sin(2 * np.pi * frequency * time + first)
    return amplitude * (shake + 0.5 * np.sin(2 * np.pi * 1.83 * frequency * time + second))


def _draw_tremble(rng: np.random.Generator) -> Array:
    tremble = np.empty((6, 4))
    tremble[:, 0] = np.repeat([0.003, 0.005], 3) * rng.uniform(0.7, 1.3, 6)
    tremble[:, 1] = rng.uniform(1.2, 2.6, 6)
    tremble[:, 2:] = rng.uniform(0, 2 * np.pi, (6, 2))
    return tremble


def round_path(rng: np.random.Generator, centre: Array) -> RoundPath:
    """Draw a walk around a place."""
    return RoundPath(
        centre=np.asarray(centre) + rng.uniform(-0.05, 0.05, 3),
        reach=np.array([1.2, 0.75, 0.1]) * rng.uniform(0.95, 1.05, 3),
        start=rng.uniform(0, 2 * np.pi),
        turn=float(rng.choice([-1.0, 1.0])),
        look_down=rng.uniform(0.1, 0.25),
        tremble=_draw_tremble(rng),
    )


def path_length(path: Callable[[float], Array]) -> float:
    """Return the length of the way between the frames of a clip [m]."""
    positions = np.array([path(frame / FRAME_RATE)[:3, 3] for frame in range(CLIP_FRAMES)])
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


def handheld_path(rng: np.random.Generator, centre: Array, target: Array) -> HandheldPath:
    """Draw an arc of 4.2 to 4.8 m in front of the target."""
    side = rng.choice([-1.0, 1.0])
    reach = np.array([side, 0.34, 0.13]) * rng.uniform(0.85, 1.15, 3)
    cycles = np.array([0.95, 0.75, 1.2]) * rng.uniform(0.9, 1.1, 3)
    phases = np.array([rng.uniform(-0.5, 0.5), rng.uniform(0, 6.28), rng.uniform(0, 6.28)])
    tremble = _draw_tremble(rng)
    wanted = rng.uniform(4.2, 4.8)
    path = HandheldPath(
        centre=np.asarray(centre) + rng.uniform(-0.1, 0.1, 3),
        reach=reach,
        cycles=cycles,
        phases=phases,
        target=np.asarray(target) + rng.uniform(-0.12, 0.12, 3),
        target_reach=np.array([0.22, 0.0, 0.1]) * rng.uniform(0.6, 1.2, 3),
        follow=-rng.uniform(0.12, 0.22),
        tremble=tremble,
    )
    # The length is nearly proportional to the reach: a few corrections meet it.
    for _ in range(4):
        path = replace(path, reach=path.reach * wanted / path_length(path))
    return path
