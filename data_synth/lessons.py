"""What the notebooks need beside their lesson: views of a room, and the true flow between them.

Written in numpy like the rest of the ray-caster, so that it can judge the package.
"""

from collections.abc import Sequence as Series
from dataclasses import dataclass

import numpy as np

from .poses import Array, Intrinsics, default_intrinsics
from .scenes import scene
from .sequence import in_order, render_frame, render_view


@dataclass(frozen=True)
class KnownViews:
    """Views of a room with everything that is known about them; the first camera is the world."""

    intrinsics: Intrinsics
    timestamps: Array  # (K,) [s]
    T_world_camera: Array  # (K, 4, 4)
    rgb: Array  # (K, height, width, 3) float32 in [0, 1]
    depth: Array  # (K, height, width) float32 [m]
    masks: Array  # (K, height, width) bool, pixels of a mover


def known_views(name: str, timestamps: Series[float], intrinsics: Intrinsics) -> KnownViews:
    """Render a scene from its path at these times, without sensor noise."""
    room = scene(name)
    path = np.array([room.path(time) for time in timestamps])
    seen = [
        render_view(room, pose, intrinsics, time)
        for pose, time in zip(path, timestamps, strict=True)
    ]
    rgb, depth, masks = (np.stack(part) for part in zip(*seen, strict=True))
    relative = np.linalg.inv(path[0]) @ path
    return KnownViews(intrinsics, np.array(timestamps), relative, rgb, depth, masks)


def known_clip(name: str, frames: Series[int], size: tuple[int, int]) -> KnownViews:
    """Return these frames of a sequence with seed 0, as `generate` does, sensor noise included."""
    room, intrinsics = scene(name), default_intrinsics(size)
    shown = list(in_order(lambda n: render_frame(room, intrinsics, frames[n]), len(frames)))
    path = np.array([frame.T_world_camera for frame in shown])
    return KnownViews(
        intrinsics=intrinsics,
        timestamps=np.array([frame.timestamp for frame in shown]),
        T_world_camera=np.linalg.inv(path[0]) @ path,
        rgb=np.array([frame.rgb for frame in shown]) / np.float32(255),
        depth=np.array([frame.depth for frame in shown]),
        masks=np.array([frame.mask for frame in shown]),
    )


def of_cells(pictures: Array, stride: int) -> Array:  # (K, height, width) -> (K, N) float64
    """Return the values at every `stride`-th pixel, row by row."""
    return pictures[:, ::stride, ::stride].reshape(len(pictures), -1).astype(np.float64)


def flow_of_cells(
    views: KnownViews,
    source: Series[int],  # (E,) views
    target: Series[int],  # (E,) views
    stride: int,  # px between cells
    walk: float = 0.0,  # m/s, speed of all movers along the world's first axis
) -> Array:  # (E, N, 2) px
    """Return where each cell of the source is seen in the target, computed from the truth."""
    camera = views.intrinsics
    first, second = np.asarray(source), np.asarray(target)
    rows, columns = np.mgrid[: camera.height : stride, : camera.width : stride]
    x, y = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    points = rays * of_cells(views.depth, stride)[first, :, None]  # in the source
    source_pose, target_pose = views.T_world_camera[first], views.T_world_camera[second]
    world = points @ source_pose[:, :3, :3].swapaxes(1, 2) + source_pose[:, None, :3, 3]
    seconds = (views.timestamps[second] - views.timestamps[first])[:, None]
    world[..., 0] += walk * seconds * of_cells(views.masks, stride)[first]
    x, y, z = np.moveaxis((world - target_pose[:, None, :3, 3]) @ target_pose[:, :3, :3], -1, 0)
    return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], -1)
