"""The sub-command `minislam eval`, in the grammar of `evo_ape tum`."""

from __future__ import annotations

import argparse
from functools import partial
from os.path import expanduser
from pathlib import Path
from typing import TYPE_CHECKING

from minislam.data.files import atomic_write, require_new, write_json
from minislam.data.run_folder import TRAJECTORY
from minislam.errors import InputError, require
from minislam.parameters import require_bounds
from minislam.runs.progress import say

if TYPE_CHECKING:
    from minislam.evaluation.trajectory import Alignment, TrajectoryError


def add_parser(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "eval",
        help="compare an estimated trajectory with the truth",
        description="Absolute trajectory error (ATE) of an estimate, or with --rpe its relative "
        "pose error (RPE); both files in TUM format; evo's word for it, tum, may come first. "
        "Without -a, -s and --no_align a Sim(3) is fitted first, since a monocular estimate has no "
        "scale of its own.",
    )
    add = parser.add_argument
    add("reference", help="ground truth, TUM format")
    add("estimate", help="estimated trajectory, TUM format, or a run folder")
    add("-a", "--align", action="store_true", help="fit rotation and translation")
    add("-s", "--correct_scale", action="store_true", help="fit the scale")
    add("--no_align", action="store_true", help="fit nothing")
    add("--t_max_diff", type=float, default=0.01, help="largest difference of timestamps [s], 0.01")
    add("--t_offset", type=float, default=0.0, help="added to the estimate's timestamps [s], 0")
    add("--rpe", action="store_true", help="relative pose error: the drift over --delta")
    add("--delta", type=float, help="length of each motion for --rpe, 1")
    add("--delta_unit", choices=("s", "f"), help="of --delta: seconds or frames, s")
    file = partial(add, type=expanduser)
    file("--save_plot", metavar="FILE.png", help="draw the trajectories to a file")
    file("--save_results", metavar="FILE.json", help="write the numbers to a file")
    add("--overwrite", action="store_true", help="replace files of these names")
    add("-v", "--verbose", action="store_true", help="say more")
    add("--silent", action="store_true", help="print nothing")
    parser.set_defaults(run=run_eval)


def run_eval(args: argparse.Namespace) -> None:
    """Compare two trajectory files."""
    from minislam.data.trajectory import read_trajectory
    from minislam.evaluation.trajectory import absolute_trajectory_error, doubt_of_units
    from minislam.records import Trajectory

    if not args.rpe and (args.delta, args.delta_unit) != (None, None):
        raise InputError("expected --rpe with --delta and --delta_unit, found none; add --rpe")
    found = f"the folder {args.reference}; give the ground truth, then the estimate"
    require(not Path(args.reference).is_dir(), "a file of true poses first", found)
    if Path(args.estimate).is_dir():
        args.estimate = str(Path(args.estimate) / TRAJECTORY)
    plot = args.save_plot and args.save_plot + ("" if Path(args.save_plot).suffix else ".png")
    for name, least in (("t_max_diff", 0), ("t_offset", -1e20)):  # that is no NaN either
        require_bounds(f"--{name}", getattr(args, name), least, 1e20)
    require_new([args.save_results, plot], args.overwrite, [args.reference, args.estimate])
    if plot and Path(plot).suffix.lower() != ".png":
        raise InputError(f"expected --save_plot FILE.png, found {plot}; give another name")
    estimate, truth = read_trajectory(args.estimate), read_trajectory(args.reference)
    shifted = Trajectory(estimate.timestamps + args.t_offset, estimate.T_world_camera)
    alignment = _alignment(args)
    result = absolute_trajectory_error(shifted, truth, alignment, args.t_max_diff)
    if doubt := doubt_of_units(shifted, truth):
        say(f"WARNING: only {len(result.errors)} pairs: {doubt}", "stderr")
    tables = {"APE w.r.t. translation part (m)": result.statistics}
    if args.rpe:
        tables = _relative_errors(args, result)
    if not args.silent:
        by_default = not (args.align or args.correct_scale or args.no_align)
        reason = ", the default for monocular estimates" if by_default else ""
        fitted = f"(with {alignment.value}{reason})"
        if args.verbose:
            print(_fit(result, len(estimate), len(truth)))
        for number, (title, table) in enumerate(tables.items()):
            rows = [f"{name:>10}\t{table[name]:.6f}" for name in sorted(table)]  # as evo prints it
            print(*[""] * number, title, fitted, "", *rows, sep="\n")
    if args.save_results:
        numbers = {
            "reference": args.reference,
            "estimate": args.estimate,
            "alignment": alignment.value,
            "pairs": len(result.errors),
            "scale": result.similarity.scale,
            "rotation": result.similarity.rotation.tolist(),
            "translation": result.similarity.translation.tolist(),
            "ate_translation": result.statistics,
            "rpe": tables if args.rpe else None,
            "timestamps_seconds": result.truth.timestamps.tolist(),
            "errors": result.errors.tolist(),
        }
        write_json(args.save_results, numbers)
    if plot:
        from minislam.viz import figure_png, trajectory_plot

        atomic_write(plot, figure_png(trajectory_plot(result.estimate, result.truth, unit="m")))


def _alignment(args: argparse.Namespace) -> Alignment:
    """Return what the flags ask to fit; without such a flag, Sim(3)."""
    from minislam.evaluation.trajectory import Alignment

    if args.no_align and (args.align or args.correct_scale):
        raise InputError("expected either --no_align or -a / -s, found both; leave one out")
    if args.align == args.correct_scale:
        return Alignment.NONE if args.no_align else Alignment.SIM3
    return Alignment.SE3 if args.align else Alignment.SCALE


def _relative_errors(
    args: argparse.Namespace, result: TrajectoryError
) -> dict[str, dict[str, float]]:
    """Return the statistics of the relative pose error after alignment, by title."""
    import numpy as np

    from minislam.evaluation.trajectory import relative_pose_error, statistics

    if len(result.truth) < 2:
        raise InputError("expected at least 2 pairs of poses for --rpe, found 1; give longer paths")
    delta, unit = 1.0 if args.delta is None else args.delta, args.delta_unit or "s"
    stamps, most = result.truth.timestamps, float(len(result.truth) - 1)  # frames
    wanted = f"as a whole number of frames, 1 to {most:g}"
    if unit == "s":
        found = "one for most of them; give a smaller --t_max_diff, or --delta_unit f"
        are_apart = bool(np.median(np.diff(stamps)) > 0)
        require(are_apart, "estimated poses that pair with different true ones", found)
        most = stamps[-1] - stamps[0]
        wanted = f"of more than 0 and at most {most:g} s, the length of the paths"
    is_possible = 0 < delta <= most and (unit == "s" or delta == int(delta))  # not NaN either
    require(is_possible, f"a --delta {wanted}", f"{delta:g} {unit}; give a value between")
    step, seconds = (1, delta) if unit == "s" else (int(delta), None)
    shifts, angles = relative_pose_error(result.estimate, result.truth, step, seconds)
    over = f"over {delta:g} {unit} ({len(shifts)} motions)"
    return {
        f"RPE w.r.t. translation part (m) {over}": statistics(shifts),
        f"RPE w.r.t. rotation angle (deg) {over}": statistics(np.rad2deg(angles)),
    }


def _fit(result: TrajectoryError, estimate_poses: int, truth_poses: int) -> str:
    """Return the number of pairs and the fitted similarity as text."""
    similarity = result.similarity
    rows = "\n".join("  " + " ".join(f"{x: .6f}" for x in row) for row in similarity.rotation)
    shift = " ".join(f"{x:.6f}" for x in similarity.translation)
    return (
        f"{len(result.errors)} pairs ({estimate_poses} estimated, {truth_poses} true poses)\n"
        f"scale {similarity.scale:.6f}, translation {shift}, rotation\n{rows}\n"
    )
