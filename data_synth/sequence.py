"""Render sequences: frame by frame, or all frames at once."""

import os
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice

import numpy as np
from scipy.spatial.transform import Rotation

from .errors import SynthError
from .motion import FRAME_RATE
from .phone import Phone, film
from .poses import Array, Intrinsics, default_intrinsics, rigid
from .render import Exposure, camera_rays, expose, trace
from .scenes import Scene, scene

NOISE_SIGMA = 0.008  # of the sensor, in units of the full range [0, 1]
NOVEL_VIEWS = 12
NOVEL_OFFSET = (0.1, 0.3)  # m, distance of a novel view from the path, at least and at most
NOVEL_ANGLE = 0.07  # rad, largest turn of a novel view about each axis
NOVEL_CLEARANCE = 0.5  # m, a novel view keeps this distance from everything
MAXIMUM_FRAMES = 100_000  # nearly an hour; a mistyped number must not fill the disk
MAXIMUM_WORKERS = 4  # more threads than that wait for each other

Progress = Callable[[int, int], None]  # frames done, frames in all


@dataclass(frozen=True)
class SyntheticFrame:
    """One frame with everything that is known about it."""

    timestamp: float  # s
    T_world_camera: Array  # (4, 4)
    rgb: Array  # (height, width, 3) uint8
    depth: Array  # (height, width) float32, z-depth of what is seen [m]
    mask: Array  # (height, width) bool, pixels of a mover
    static_rgb: Array  # (height, width, 3) uint8, the same view without movers and without noise


@dataclass(frozen=True)
class SyntheticSequence:
    """A whole sequence with its truth. Images hold the values of the PNG files, divided by 255."""

    name: str
    seed: int
    intrinsics: Intrinsics
    timestamps: Array  # (F,) [s]
    T_world_camera: Array  # (F, 4, 4)
    rgb: Array  # (F, height, width, 3) float32 in [0, 1]
    depth: Array  # (F, height, width) float32 [m]
    masks: Array  # (F, height, width) bool
    static_rgb: Array  # (F, height, width, 3) float32 in [0, 1]
    novel_rgb: Array  # (N, height, width, 3) float32 in [0, 1]
    novel_T_world_camera: Array  # (N, 4, 4)


def render_view(
    view: Scene,
    T_world_camera: Array,  # (4, 4)
    intrinsics: Intrinsics,
    time: float,  # s
    movers: bool = True,
) -> tuple[Array, Array, Array]:  # rgb (h, w, 3) float32 in [0, 1], depth (h, w) [m], mask (h, w)
    """Render a scene from any pose at any time, without sensor noise."""
    exposure = _expose(view, T_world_camera, intrinsics, time, movers)
    return exposure.rgb, exposure.depth, exposure.mover_mask


def _expose(
    view: Scene, T_world_camera: Array, intrinsics: Intrinsics, time: float, movers: bool
) -> Exposure:
    parts = view.mover_parts(time) if movers else []
    counted = view.counts_as_moving(time) if movers else []
    room = view.room
    return expose(room.parts, parts, counted, room.lamp, T_world_camera, intrinsics)


def to_bytes(image: Array) -> Array:
    """Return an image in [0, 1] as uint8."""
    return np.clip(np.round(image * 255), 0, 255).astype(np.uint8)


def render_frame(
    view: Scene,
    intrinsics: Intrinsics,
    index: int,
    noise: bool = True,
    phone: Phone | None = None,  # films the image; all else stays as it is
) -> SyntheticFrame:
    """Render frame `index` of a scene; it is the same however many frames are asked for."""
    time = index / FRAME_RATE
    T_world_camera = view.path(time)
    exposure = _expose(view, T_world_camera, intrinsics, time, movers=True)
    rgb = film(view, intrinsics, time, phone) if phone else exposure.rgb
    if noise:
        rng = np.random.default_rng([zlib.crc32(view.name.encode()), view.seed, index])
        rgb = rgb + np.float32(NOISE_SIGMA) * rng.standard_normal(rgb.shape, np.float32)
    return SyntheticFrame(
        timestamp=time,
        T_world_camera=T_world_camera,
        rgb=to_bytes(rgb),
        depth=exposure.depth,
        mask=exposure.mover_mask,
        static_rgb=to_bytes(exposure.static_rgb),
    )


def in_order(function: Callable[[int], object], count: int) -> Iterator:
    """Yield function(0), function(1), ... computed by a few threads, a few results ahead.

    Threads suffice: numpy and OpenCV release the interpreter while they work on an image. Each
    result depends on its index alone, so the number of threads changes nothing but the time.
    """
    workers = min(MAXIMUM_WORKERS, os.cpu_count() or 1, max(count, 1))
    with ThreadPoolExecutor(workers) as pool:
        indices = iter(range(count))
        waiting = [pool.submit(function, index) for index in islice(indices, 2 * workers)]
        while waiting:
            yield waiting.pop(0).result()
            waiting += [pool.submit(function, index) for index in islice(indices, 1)]


def novel_poses(view: Scene, frames: int) -> Array:  # (N, 4, 4)
    """Draw held-out poses beside the path, looking at what the path has seen."""
    rng = np.random.default_rng([zlib.crc32(b"novel " + view.name.encode()), view.seed])
    camera = default_intrinsics((16, 12))  # coarse: only asked for its distance to things
    walked = np.array([view.path(index / FRAME_RATE)[:3, 3] for index in range(frames)])
    poses = []
    for index in range(NOVEL_VIEWS):
        on_path = view.path((index + 0.5) / NOVEL_VIEWS * max(frames - 1, 0) / FRAME_RATE)
        while True:
            direction = rng.standard_normal(3)
            offset = rng.uniform(*NOVEL_OFFSET) * direction / np.linalg.norm(direction)
            turn = Rotation.from_rotvec(rng.uniform(-NOVEL_ANGLE, NOVEL_ANGLE, 3)).as_matrix()
            pose = on_path @ rigid(turn, offset)
            aside = np.linalg.norm(walked - pose[:3, 3], axis=1).min()
            depth, _ = trace(view.room.parts, camera_rays(camera, pose))
            if aside >= NOVEL_OFFSET[0] and depth.min() > NOVEL_CLEARANCE:
                break
        poses.append(pose)
    return np.array(poses)


def check_request(frames: int, size: tuple[int, int]) -> None:
    """Raise SynthError where a sequence cannot be generated as asked."""
    if frames < 1:
        raise SynthError(f"a sequence needs at least 1 frame, not {frames}")
    if frames > MAXIMUM_FRAMES:
        raise SynthError(f"a sequence has at most {MAXIMUM_FRAMES:,} frames, not {frames:,}")
    if min(size) < 16 or max(size) > 4096:
        raise SynthError(f"width and height must be 16 to 4096 pixels, not {size[0]}x{size[1]}")


def generate(
    name: str,
    seed: int = 0,
    frames: int = 100,
    size: tuple[int, int] = (320, 240),  # width, height
) -> SyntheticSequence:
    """Generate a sequence in memory."""
    check_request(frames, size)
    view, intrinsics = scene(name, seed), default_intrinsics(size)
    rendered = list(in_order(lambda i: render_frame(view, intrinsics, i), frames))
    poses = novel_poses(view, frames)
    novel = list(in_order(lambda i: novel_image(view, intrinsics, poses[i]), len(poses)))
    full = np.float32(255)
    return SyntheticSequence(
        name=name,
        seed=seed,
        intrinsics=intrinsics,
        timestamps=np.array([frame.timestamp for frame in rendered]),
        T_world_camera=np.array([frame.T_world_camera for frame in rendered]),
        rgb=np.array([frame.rgb for frame in rendered]) / full,
        depth=np.array([frame.depth for frame in rendered]),
        masks=np.array([frame.mask for frame in rendered]),
        static_rgb=np.array([frame.static_rgb for frame in rendered]) / full,
        novel_rgb=np.array(novel) / full,
        novel_T_world_camera=poses,
    )


def novel_image(view: Scene, intrinsics: Intrinsics, T_world_camera: Array) -> Array:
    """Return the still world from a pose, (height, width, 3) uint8, without noise."""
    return to_bytes(render_view(view, T_world_camera, intrinsics, 0.0, movers=False)[0])
