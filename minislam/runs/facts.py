"""What a run reports: run.json with its warnings, and metrics.json."""

import math
import platform
import sys
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import cv2
import numpy as np
import scipy
import torch

import minislam
from minislam.evaluation.images import psnr
from minislam.evaluation.lpips import Lpips
from minislam.evaluation.metrics import MappedView, ate_cm, measure_run
from minislam.mapping.mapper import Mapper, surface_depth
from minislam.priors.choice import PriorChoice
from minislam.records import MapImage, Trajectory
from minislam.runs.resume import Checkpoints
from minislam.runs.warnings import guessed_depth, left_out, shown_static, warnings
from minislam.slam import Slam
from minislam.splatting import Rendering
from minislam.state.memory import peak_memory_mb
from minislam.tracking.optimisation import bundle_problem, typical_residual
from minislam.tracking.safeguards.exposure import with_exposure

MOST_UNSEEN = 20  # frames, evenly spread, that the map is compared with


def run_facts(
    slam: Slam, choice: PriorChoice, checkpoints: Checkpoints, state: str, exit_code: int | None
) -> dict[str, Any]:
    """Return the content of run.json: the command, how long the run took, and how it ended."""
    graph, fit = slam.tracker.graph, slam.focal_length
    stamps = [tracked.timestamp for tracked in slam.tracker.tracked]
    steps = [frame.step for frame in graph.keyframes.frames[:1]]  # of the source
    return {
        "version": minislam.__version__,
        "command": sys.argv,
        "versions": {
            "python": platform.python_version(),
            **{library.__name__: library.__version__ for library in (torch, np, scipy, cv2)},
        },
        "platform": platform.platform(),
        "sequence": slam.sequence.description,
        "priors": asdict(choice),
        "seed": slam.config.seed,
        "state": state,
        "exit_code": exit_code,
        "warnings": [*warnings(slam, choice.depth), *filter(None, [checkpoints.problem])],
        "seconds": {"total": checkpoints.run_seconds, **slam.steps.seconds},
        "checkpoint_seconds": checkpoints.seconds,
        "frames": len(slam.tracker.tracked),
        "keyframes": len(slam.tracker.keyframes),
        "lost_frames": len(slam.lost_frames()),
        "unread_images": len(slam.sequence.unread),
        "adjustments": graph.adjustments,
        "failed_adjustments": graph.failed_adjustments,
        "gaussians": len(slam.mapper.gaussians),
        "unit": unit_of(slam),
        "camera": asdict(slam.tracker.grid.camera),
        "focal_length": {"used": focal_length_note(slam)}
        | (asdict(fit) | {"is_doubtful": fit.is_doubtful} if fit else {}),
        "began_anew": {"lens": asdict(slam.undone_lens)} if slam.undone_lens else None,
        "readout_seconds": list(graph.shutter.readout),
        "frame_seconds": min([float(np.median(np.diff(stamps))), *steps]) if stamps[1:] else None,
        "breaks": [asdict(found) for found in slam.tracker.watch.breaks],
        "segments": slam.tracker.watch.segments,
        "keyframe_diagnostics": [asdict(d) for d in slam.tracker.watch.diagnostics],
    }


def unit_of(slam: Slam) -> str:
    """Return the unit of length of trajectory and map."""
    return "m" if slam.tracker.keyframes.has_prior else "world units"


def focal_length_note(slam: Slam) -> str:
    """Return which focal length was used, and where it comes from."""
    camera, graph = slam.tracker.grid.camera, slam.tracker.graph
    if not graph.seeks_focal:
        origin = "as given"
    elif graph.focal_is_free:
        origin = f"estimated from the motion, from {slam.sequence.camera.fx:.1f} px on"
    elif not slam.tracker.initialised:
        origin = "not sought yet"
    else:
        origin = "kept as at the start, because the motion does not tell it"
    return f"{camera.fx:.1f} px for {camera.width}x{camera.height} images, {origin}"


def measure(slam: Slam, seconds: float, lpips: Lpips | None) -> dict[str, Any]:
    """Return the content of metrics.json."""
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
    for index, (keyframe, rendering) in enumerate(shown):
        color, depth = rendering.color.clamp(0, 1), surface_depth(rendering)
        beta = slam.beta_image(index) if slam.config.uncertainty.is_learned else None
        yield MappedView(
            keyframe.frame_index,
            color=color.cpu().numpy(),
            depth=depth.cpu().numpy(),
            beta=beta,
            static_psnr=_static_psnr(mapper, keyframe, rendering),
        )


def unseen_psnr(slam: Slam) -> float | None:
    """Return the PSNR [dB] of up to 20 frames beside the map's, where beta finds them static."""
    mapper, seen = slam.mapper, {keyframe.frame_index for keyframe in slam.mapper.images}
    mapped = slam.tracker.watch.longest_piece(slam.poses)
    others = [index for index in mapped if index not in seen]
    sample = others[:: math.ceil(len(others) / MOST_UNSEEN) or 1]
    keyframes = slam.map_images(first=len(slam.tracker.keyframes), others=sample)
    views = [with_exposure(keyframe, mapper.exposures) for keyframe in keyframes]
    found = [_static_psnr(mapper, view, mapper.render(view.T_camera_world)) for view in views]
    known = [value for value in found if value is not None]
    return float(np.mean(known)) if known else None


def _static_psnr(mapper: Mapper, keyframe: MapImage, rendering: Rendering) -> float | None:
    """Compare the map, as it is exposed there, with a keyframe where beta finds it static."""
    static = mapper.static_weight(mapper.beta_of(keyframe), mapper.camera) > 0
    pictures = keyframe.exposed(rendering.color), keyframe.image, static
    return psnr(*(picture.cpu() for picture in pictures)) if static.any() else None


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
