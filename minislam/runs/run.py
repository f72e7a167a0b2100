"""One run from a name to a folder: read the sequence, do SLAM, measure it, write everything."""

import resource
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

import minislam
from minislam.allocator import keep_freed_memory
from minislam.config import SlamConfig, as_json
from minislam.data import GaussianArrays, RunFolder
from minislam.errors import InputError, MinislamError
from minislam.evaluation import absolute_trajectory_error
from minislam.evaluation.lpips import Lpips
from minislam.evaluation.metrics import MAX_DIFFERENCE, MappedView, measure_run
from minislam.geometry import se3_inverse
from minislam.mapping.views import surface_depth
from minislam.priors.choice import FILES, PriorChoice, choose_depth, choose_features, choose_flow
from minislam.priors.networks.checkpoints import load_checkpoint
from minislam.records import Sequence
from minislam.runs.resume import Checkpoints
from minislam.slam import Priors, Slam
from minislam.state.steps import Report, silent
from minislam.uncertainty.resampling import resample
from minislam.viz import (
    ate_over_time,
    beta_to_rgb,
    build_report,
    depth_to_rgb,
    figure_png,
    keyframe_strip,
    loss_curves,
    map_growth,
    online_uncertainty,
    overview,
    trajectory_plot,
)

MAX_STRIPS = 6  # keyframes shown in the report
FAILED_EXIT, LOST_EXIT, INTERRUPTED_EXIT = 1, 3, 130  # exit codes of a run that is not whole


@dataclass(frozen=True)
class RunOutcome:
    """What a finished or interrupted run has to say."""

    metrics: dict[str, float | None]
    warnings: list[str]
    exit_code: int
    state: str  # "finished", "finished, partly lost" or "interrupted"


def choose_priors(choice: PriorChoice, sequence: Sequence, config: SlamConfig) -> Priors:
    """Return the priors that are named, their files read and checked."""
    networks, factor = config.networks, config.uncertainty.grid_factor
    if choice.features.startswith(FILES) and factor != 1:
        raise InputError(
            f"expected uncertainty.grid_factor 1 with --features {FILES}FOLDER, found {factor}; a "
            "finer grid needs the network: give the factor to minislam priors"
        )
    return Priors(
        choose_flow(choice, config.flow, networks),
        choose_features(choice, sequence.camera, config.features, networks),
        choose_depth(choice, sequence, config.seed, config.simulated_depth, networks),
    )


def load_lpips(trunk: Path | str, heads: Path | str) -> Lpips:
    """Read the two files of LPIPS."""
    files = [load_checkpoint(Path(file).expanduser()) for file in (trunk, heads)]
    return Lpips(*(weights.as_dict() for weights in files))


def run_sequence(
    sequence: Sequence,
    config: SlamConfig,
    choice: PriorChoice,
    priors: Priors,  # as chosen
    folder: RunFolder,
    report: Report = silent,
    lpips: Lpips | None = None,
    resume: bool = False,
) -> RunOutcome:
    """Run SLAM on a sequence and write the run folder, also when it is interrupted.

    With `resume`, an interrupted run goes on from the checkpoint in its folder.
    """
    keep_freed_memory()
    torch.set_num_threads(config.threads)
    checkpoints = Checkpoints(folder, sequence, config, choice)
    slam = Slam(sequence, config, priors, report, checkpoints.keep)
    if resume:
        checkpoints.restore(slam)
    folder.write_config(as_json(config))
    interrupted = False
    try:
        slam.run()
    except KeyboardInterrupt:
        interrupted = True
        if not slam.mapper.keyframes:  # there is nothing to save yet
            folder.write_run(_facts(slam, choice, checkpoints, "interrupted", INTERRUPTED_EXIT))
            raise
    except MinislamError as error:
        folder.write_run(_facts(slam, choice, checkpoints, f"failed: {error}", FAILED_EXIT))
        raise
    seconds = checkpoints.run_seconds
    lost = slam.lost_frames()
    state = "finished, partly lost" if lost else "finished"
    exit_code = LOST_EXIT if lost else 0
    if interrupted:
        state, exit_code = "interrupted", INTERRUPTED_EXIT
    facts = _facts(slam, choice, checkpoints, state, exit_code)
    _write_estimates(folder, slam)
    metrics = _measure(slam, seconds, lpips)
    folder.write_metrics(metrics)
    outcome = RunOutcome(metrics, facts["warnings"], exit_code, state)
    _write_pictures(folder, slam, outcome)
    folder.write_run(facts)
    if not interrupted:
        folder.remove_checkpoint()
    return outcome


def _facts(
    slam: Slam, choice: PriorChoice, checkpoints: Checkpoints, state: str, exit_code: int
) -> dict[str, Any]:
    """Return what run.json says: how the run was asked for, how long it took, how it ended."""
    return {
        "version": minislam.__version__,
        "command": sys.argv,
        "sequence": slam.sequence.description,
        "priors": asdict(choice),
        "seed": slam.config.seed,
        "state": state,
        "exit_code": exit_code,
        "warnings": _warnings(slam) + ([checkpoints.problem] if checkpoints.problem else []),
        "seconds": {"total": checkpoints.run_seconds, **slam.steps.seconds},
        "checkpoint_seconds": checkpoints.seconds,
        "frames": len(slam.tracker.tracked),
        "keyframes": len(slam.tracker.keyframes),
        "lost_frames": len(slam.lost_frames()),
        "gaussians": len(slam.mapper.gaussians),
        "focal_length": asdict(slam.focal_length) if slam.focal_length else None,
        "health": [asdict(health) for health in slam.tracker.health],
    }


def _write_estimates(folder: RunFolder, slam: Slam) -> None:
    folder.write_trajectory(slam.trajectory())
    folder.write_keyframe_trajectory(slam.keyframe_trajectory())
    folder.write_lost_frames(slam.lost_frames())
    arrays = slam.mapper.gaussians.to_arrays()
    arrays.pop("anchor_keyframe")
    folder.write_map(GaussianArrays(**arrays))
    folder.write_mlp(slam.mapper.mlp.state_dict())


def _measure(slam: Slam, seconds: float, lpips: Lpips | None) -> dict[str, Any]:
    views = [
        MappedView(
            keyframe.frame_index,
            se3_inverse(keyframe.T_camera_world).numpy(),
            _beta_image(slam, index) if slam.config.uncertainty.is_learnt else None,
            surface_depth(slam.mapper.render(keyframe.T_camera_world)).numpy(),
        )
        for index, keyframe in enumerate(slam.mapper.keyframes)
    ]
    metrics: dict[str, Any] = measure_run(
        slam.sequence.ground_truth,
        slam.trajectory(),
        slam.keyframe_trajectory(),
        views,
        lambda pose: _rendered(slam, pose),
        lpips,
    )
    metrics["seconds_total"] = seconds
    metrics["frames_per_second"] = len(slam.tracker.tracked) / seconds
    # Kilobytes on Linux. The largest the process has been, reading and interpreter included.
    metrics["peak_memory_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return metrics


def _rendered(slam: Slam, T_world_camera: np.ndarray) -> np.ndarray:
    pose = se3_inverse(torch.from_numpy(T_world_camera))
    return slam.mapper.render(pose).color.clamp(0, 1).numpy()


def _beta_image(slam: Slam, index: int) -> np.ndarray:
    """Return beta (H, W) of a keyframe; without uncertainty every pixel is trusted alike."""
    camera = slam.sequence.camera
    if not slam.config.uncertainty.enabled:
        return np.ones((camera.height, camera.width), np.float32)
    beta = slam.mapper.beta_of(slam.mapper.keyframes[index])
    return resample(beta, camera.height, camera.width).numpy()


def _warnings(slam: Slam) -> list[str]:
    warnings = list(slam.sequence.warnings)
    lost = len(slam.lost_frames())
    if lost:
        warnings.append(
            f"{lost} of {len(slam.tracker.tracked)} frames could not be followed and have no "
            "pose; lost_frames.txt lists them"
        )
    warnings += _focal_length_warnings(slam) + _health_warnings(slam)
    if not slam.tracker.keyframes.has_prior:
        warnings.append("without a depth prior the unit of length is arbitrary")
    return warnings


def _focal_length_warnings(slam: Slam) -> list[str]:
    fit = slam.focal_length
    if fit is None or not fit.is_doubtful:
        return []
    factor = f"{fit.factor:.2f}"
    return [
        f"the flow fits {factor} times the present focal length better, with {fit.saved:.0%} less "
        f"cost: check the calibration, or give {factor} times the present --fx and --fy"
    ]


def _health_warnings(slam: Slam) -> list[str]:
    """Return what a user should know about how the keyframes hang together."""
    health = slam.tracker.health
    least = slam.config.tracking.min_parallax * slam.tracker.backend.pixel_scale
    without = sum(keyframe.parallax < least for keyframe in health)
    if not without or 2 * without < len(health):
        return []
    return [
        f"{without} of {len(health)} keyframes show hardly any parallax: the camera turned or "
        "stood, so the distances it covered are not determined"
    ]


def _write_pictures(folder: RunFolder, slam: Slam, outcome: RunOutcome) -> None:
    """Write keyframe images, plots and the report."""
    truth = slam.sequence.ground_truth
    true_path, unit, estimate = None, "world units", slam.trajectory()
    plots: dict[str, tuple[str, bytes]] = {}  # caption and PNG, by name
    if outcome.metrics["ate_all_cm"] is not None:
        error = absolute_trajectory_error(estimate, truth.trajectory, max_difference=MAX_DIFFERENCE)
        estimate, true_path, unit = error.estimate, error.truth, "m"
        over_time = figure_png(ate_over_time(estimate.timestamps, error.errors, unit))
        plots["ate_over_time"] = "Error over time", over_time
    plots["trajectory"] = "Trajectory", figure_png(trajectory_plot(estimate, true_path, unit))
    history = slam.mapper.history
    curves = {"L_render": history.render, "L_color": history.color, "L_uncer": history.uncertainty}
    plots["losses"] = "Losses", figure_png(loss_curves(curves))
    plots["gaussians"] = "Size of the map", figure_png(map_growth(history.gaussians))
    if slam.config.uncertainty.is_learnt and slam.snapshots.moments:
        plots["online_uncertainty"] = "What the MLP had learnt by then", _online_beta(slam)
    for name, (_, png) in plots.items():
        folder.write_plot(name, png)

    strips = _write_keyframes(folder, slam)
    middle = len(slam.mapper.keyframes) // 2
    keyframe, beta = slam.mapper.keyframes[middle], _beta_image(slam, middle)
    color = slam.mapper.render(keyframe.T_camera_world).color.clamp(0, 1).numpy()
    picture = overview(keyframe.image.numpy(), beta, color, estimate, true_path, unit)
    folder.write_plot("overview", figure_png(picture))
    summary = {name: _shown(value) for name, value in outcome.metrics.items()}
    figures = [plots.pop("trajectory"), *strips, *plots.values()]
    title = f"minislam: {slam.sequence.name}"
    folder.write_report(build_report(title, summary, outcome.warnings, figures))


def _write_keyframes(folder: RunFolder, slam: Slam) -> list[tuple[str, bytes]]:
    """Write the pictures of all keyframes; return some of them as strips with captions."""
    strips: list[tuple[str, bytes]] = []
    count = len(slam.mapper.keyframes)
    shown = set(np.linspace(0, count - 1, min(MAX_STRIPS, count)).round().astype(int).tolist())
    for index, keyframe in enumerate(slam.mapper.keyframes):
        rendering = slam.mapper.render(keyframe.T_camera_world)
        image, beta = keyframe.image.numpy(), _beta_image(slam, index)
        color, depth = rendering.color.clamp(0, 1).numpy(), rendering.depth.numpy()
        number = keyframe.frame_index
        folder.write_keyframe_image(number, "input", image)
        folder.write_keyframe_image(number, "render", color)
        folder.write_keyframe_image(number, "depth", depth_to_rgb(depth))
        folder.write_keyframe_image(number, "beta", beta_to_rgb(beta))
        if index in shown:
            strip = figure_png(keyframe_strip(image, depth, beta, color, f"frame {number}"))
            strips.append((f"Keyframe {index}, frame {number}", strip))
    return strips


def _online_beta(slam: Slam) -> bytes:
    """Draw how beta of the keyframe with most movement came about: first, then, and at last."""
    count = len(slam.mapper.keyframes)
    index = max(range(count), key=lambda k: float(_beta_image(slam, k).mean()))
    number, moments = slam.mapper.keyframes[index].frame_index, slam.snapshots.moments
    later = [moment for moment in moments if moment >= number]
    chosen = sorted({moments[0], later[0] if later else moments[-1], moments[-1]})
    betas = slam.online_beta(number, chosen)
    named = {f"learnt until frame {k}": b.numpy() for k, b in zip(chosen, betas, strict=True)}
    image = slam.mapper.keyframes[index].image.numpy()
    return figure_png(online_uncertainty(image, named, f"uncertainty of frame {number}"))


def _shown(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3f}"
