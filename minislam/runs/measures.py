"""The content of metrics.json: errors against the truth, and what is measured without it."""

import math
from collections.abc import Iterator

import numpy as np
from torch import Tensor

from minislam.data.files import Json
from minislam.evaluation.images import psnr
from minislam.evaluation.lpips import Lpips
from minislam.evaluation.metrics import MappedView, ate_cm, measure_run
from minislam.mapping.mapper import Mapper, surface_depth
from minislam.records import MapImage, Trajectory
from minislam.slam import Slam
from minislam.splatting import Rendering
from minislam.state.memory import peak_memory_mb
from minislam.tracking.optimisation import bundle_problem, typical_residual
from minislam.tracking.safeguards.exposure import with_exposure

MOST_UNSEEN = 20  # frames, evenly spread, that the map is compared with


def measure(slam: Slam, seconds: float, lpips: Lpips | None) -> Json:
    """Return the measures by name, units in the names; None for what cannot be known."""
    truth, paths = slam.sequence.ground_truth, (slam.trajectory(), slam.keyframe_trajectory())
    return {
        **measure_run(truth, *paths, mapped_views(slam), slam.render, lpips),
        **_segment_errors(slam),
        "psnr_unseen_db": unseen_psnr(slam),
        "focal_length_px": slam.tracker.grid.camera.fx,
        "seconds_total": seconds,
        "frames_per_second": len(slam.tracker.tracked) / seconds,
        "peak_memory_mb": peak_memory_mb(),
        "left_out": left_out(slam) if slam.config.uncertainty.enabled else None,
        "shown_static": shown_static(slam),
        "guessed_depth": guessed_depth(slam),
        **_ties(slam),
    }


def mapped_views(slam: Slam) -> Iterator[MappedView]:
    """Yield what the map shows of each of its images, and how well it fits what stands still."""
    mapper = slam.mapper
    shown = zip(mapper.images, mapper.renderings(mapper.images), strict=True)
    for index, (image, rendering) in enumerate(shown):
        color, depth = rendering.color.clamp(0, 1), surface_depth(rendering)
        seen = color.cpu().numpy(), depth.cpu().numpy()
        beta = slam.beta_image(index) if slam.config.uncertainty.is_learned else None
        static_psnr = _static_psnr(mapper, image, rendering)
        yield MappedView(image.frame_index, *seen, beta, static_psnr)


def unseen_psnr(slam: Slam) -> float | None:
    """Return the PSNR [dB] of up to 20 frames beside the map's, where beta finds them static."""
    mapper, seen = slam.mapper, {image.frame_index for image in slam.mapper.images}
    mapped = slam.tracker.watch.longest_piece(slam.poses)
    others = [index for index in mapped if index not in seen]
    sample = others[:: math.ceil(len(others) / MOST_UNSEEN) or 1]
    images = slam.map_images(first=len(slam.tracker.keyframes), others=sample)
    views = [with_exposure(image, mapper.exposures) for image in images]
    found = [_static_psnr(mapper, view, mapper.render(view.T_camera_world)) for view in views]
    known = [value for value in found if value is not None]
    return float(np.mean(known)) if known else None


def _static_psnr(mapper: Mapper, image: MapImage, rendering: Rendering) -> float | None:
    """Compare the map, as it is exposed there, with an image where beta finds it static."""
    static = _is_static(mapper, image)
    compared = image.exposed(rendering.color), image.image, static
    return psnr(*(pixels.cpu() for pixels in compared)) if static.any() else None


def _ties(slam: Slam) -> dict[str, float | None]:
    """Return the length of the path, and how well poses, depths and flow agree, without truth."""
    graph, centres = slam.tracker.graph, slam.trajectory().centres
    every = range(len(graph.edges))
    error = typical_residual(bundle_problem(graph, every), graph.state) if every else None
    return {
        "path_length": float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum()),
        "reprojection_px": error,
        "beyond_turns_px": slam.tracker.watch.beyond_turns,
        "depth_difference": slam.tracker.watch.depth_difference,
    }


def _segment_errors(slam: Slam) -> dict[str, float | None]:
    """Return the ATE of each segment of a broken trajectory, aligned by itself [cm]."""
    truth, watch = slam.sequence.ground_truth, slam.tracker.watch
    if truth is None or truth.trajectory is None or not watch.breaks:
        return {}
    trajectory, errors = slam.trajectory(), {}
    times = trajectory.timestamps
    stamp = {tracked.frame_index: tracked.timestamp for tracked in slam.tracker.tracked}
    for first, last in watch.segments:
        inside = (times >= stamp[first]) & (times <= stamp[last])
        piece = Trajectory(times[inside], trajectory.T_world_camera[inside])
        errors[f"ate_{first}_to_{last}_cm"] = ate_cm(piece, truth.trajectory)
    return errors


def shown_static(slam: Slam) -> float | None:
    """Return the fraction of what stands still that the map shows [-]; None before the end."""
    return float(np.mean(slam.mapper.shown)) if slam.mapper.shown else None


def left_out(slam: Slam) -> float | None:
    """Return the fraction of the map's images that beta leaves out [-]; None before the end."""
    images = slam.mapper.images if slam.mapper.shown else []
    moving = [float((~_is_static(slam.mapper, image)).float().mean()) for image in images]
    return float(np.mean(moving)) if moving else None


def guessed_depth(slam: Slam) -> float | None:
    """Return the fraction of the keyframes' static pixels whose depth nothing has measured [-]."""
    guessed = []
    for image in slam.mapper.images:
        static = _is_static(slam.mapper, image)
        if image.inserts and static.any():
            unknown = image.depth == 0 if image.filled is None else image.filled
            guessed.append(float(unknown[static].float().mean()))
    return float(np.mean(guessed)) if guessed else None


def _is_static(mapper: Mapper, image: MapImage) -> Tensor:  # (H, W) bool
    """Return where beta takes an image for static."""
    return mapper.static_weight(mapper.beta_of(image), mapper.camera) > 0
