"""The content of run.json: the command, warnings, how long the run took, and how it ended."""

import platform
import sys
from dataclasses import asdict

import cv2
import numpy as np
import scipy
import torch

import minislam
from minislam.data.files import Json
from minislam.priors.choice import PriorChoice
from minislam.runs.resume import Checkpoints
from minislam.runs.warnings import warnings
from minislam.slam import Slam


def run_facts(
    slam: Slam, choice: PriorChoice, checkpoints: Checkpoints, state: str, exit_code: int | None
) -> Json:
    """Return the content of run.json."""
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
