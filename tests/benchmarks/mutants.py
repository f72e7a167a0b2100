"""Break the package one line at a time: does a fast test of the same room notice?

    python -m tests.benchmarks.mutants [WORD ...]

Each mutant is one replacement in one file, tried in a scratch copy of the clone, on the tests that
stand beside it. A survivor needs a test, or is an equivalent: a change that changes nothing.
With words, only mutants whose file contains one of them.
"""

import contextlib
import os
import shutil
import signal
import sys
import tempfile
from collections import Counter
from functools import cache
from pathlib import Path

import cv2  # noqa: F401  (imported once here, not once per mutant)
import numpy  # noqa: F401
import pytest
import scipy.spatial.transform  # noqa: F401
import torch

ROOT = Path(__file__).parents[2]
ALARM = 120  # s; a mutant that takes longer hangs, and that is noticed

# (file below minislam/, test files below tests/): what it says, what the mutant says
MUTANTS: dict[tuple[str, str], list[tuple[str, str]]] = {
    ("cli/main.py", "cli/test_main.py"): [
        (', "TRIM_THRESHOLD_": (-1, 64 << 20)', ""),
        ('if f"MALLOC_{name}" not in os.environ:', "if True:"),
    ],
    ("geometry/se3.py", "geometry/test_se3.py"): [
        ("-(rotation_t @ transforms", "(rotation_t @ transforms"),
        ("1.5 * eye - 0.5 *", "1.5 * eye - 0.4 *"),
        ("torch.where(q[..., :1] < 0, -q, q)", "q"),
    ],
    ("geometry/camera.py", "geometry/test_camera.py"): [
        ("(self.cx + 0.5) * sx - 0.5", "self.cx * sx"),
        ("fx * (1 + a * a)", "fx * (1 - a * a)"),
    ],
    ("geometry/alignment.py", "geometry/test_alignment.py"): [
        ("target_mean - scale *", "target_mean -"),
    ],
    ("uncertainty/weights.py", "uncertainty/test_weights.py"): [
        ("1 + (1 - position)", "1 - (1 - position)"),
        ("torch.where(weight < least", "torch.where(weight > least"),
        ("(weight / weight.quantile(1 - STATIC_FRACTION))", "weight"),
    ],
    ("uncertainty/losses.py", "uncertainty/test_losses.py"): [
        ("contrast.clamp_max(STRUCTURE_CAP)", "contrast"),
        ("opacity >= SURFACE_OPACITY", "opacity >= 0"),
        ("& (reference_depth < far_limit)", ""),
        ('mode="reflect"', 'mode="constant"'),
        ("/ beta**2 +", "/ beta +"),
    ],
    ("mapping/window.py", "mapping/test_window.py"): [
        ("min(int(seen_a.sum()), ", "max(int(seen_a.sum()), "),
        ("non_overlapping[-1]", "non_overlapping[0]"),
        ("crowding = candidates.sum(-1)", "crowding = -candidates.sum(-1)"),
        ("(1 - window_probability) / (", "window_probability / ("),
    ],
    ("mapping/insertion.py", "mapping/test_insertion.py"): [
        ("& (weight > 0)", ""),
        ("opacity < EXPLAINED_OPACITY", "opacity > EXPLAINED_OPACITY"),
        ("torch.where(known, priority, -1)", "priority"),
        ("in_front & (weight", "(weight"),
        ("config.cell * z / focal", "config.cell / focal"),
    ],
    ("mapping/losses.py", "mapping/test_losses.py"): [
        ("slopes * (v_loss / -len(x))", "slopes * (v_loss / len(x))"),
        ("image.sum(-1) > BLACK", "image.sum(-1) >= 0"),
        ("in_front & (opacity", "(opacity"),
        ("(scales - scales.mean(-1, keepdim=True))", "scales"),
    ],
    ("mapping/mapper.py", "mapping/test_mapper.py"): [
        ("self.camera) > 0\n        shown", "self.camera) > -1\n        shown"),
        ("opacity[static] > OPAQUE", "opacity[static] < OPAQUE"),
    ],
    ("runs/facts.py", "runs/test_facts.py runs/test_run_ending.py"): [
        ("shown is not None and shown < LEAST_SHOWN", "bool(shown) and shown < LEAST_SHOWN"),
        ("np.argmin(slam.mapper.shown)", "np.argmax(slam.mapper.shown)"),
    ],
    ("tracking/initialisation.py", "tracking/test_initialisation.py"): [
        ("(below, -right, right)", "(-below, -right, right)"),
        ("for other in OTHER_FOCALS for result", "for other in () for result"),
        ("(1 - FOCAL_WORTH_SAVING) * report", "0 * report"),
        ("else (state, report)", "else best"),
    ],
    ("tracking/safeguards/first_depth.py", "tracking/safeguards/test_first_depth.py"): [
        ("* doublings - RELIEF", "* doublings + RELIEF"),
        ("usual, cells = known_disparities.log(), known", "pass"),
    ],
    ("tracking/safeguards/focal_length.py", "tracking/safeguards/test_focal_length.py"): [
        ("(free, start or state)", "(free, state)"),
    ],
    ("tracking/bundle_adjustment.py", "tracking/test_bundle_adjustment_steps.py"): [
        ("trial <= cost", "trial <= 1.001 * cost"),
    ],
    ("tracking/bundle_adjustment.py",
     "tracking/test_bundle_adjustment_steps.py tracking/test_bundle_adjustment.py"): [
        ("max(level / 10, damping)", "damping"),
    ],
    ("tracking/safeguards/robust.py", "tracking/safeguards/test_robust.py"): [
        ("-self.power", "-1"),
        ("self.scale**2 * torch.log1p", "torch.log1p"),
        ("max(residual, MIN_RESIDUAL)", "residual"),
        ("min(width, self.scale)", "width"),
    ],
    ("tracking/optimisation.py", "tracking/test_optimisation.py"): [
        ("settled=is_last", "settled=True"),
        ("0, len(problem.rays), EVERY", "0, len(problem.rays) // 2, EVERY"),
        ("lengths(residual), weights[:, 0]", "lengths(residual), 1 + 0 * weights[:, 0]"),
        ("static[:, None]", "of_cell[source][:, None]"),
    ],
    ("tracking/safeguards/motion_memory.py", "tracking/safeguards/test_motion_memory.py"): [
        ("LOSS_RATE, RECOVERY_RATE)", "RECOVERY_RATE, LOSS_RATE)"),
        ('"amin"', '"amax"'),
        ("+ DEPTH_ERROR**2 * parallax", ""),
    ],
    ("tracking/safeguards/settling.py", "tracking/safeguards/test_settling.py"): [
        ("information > SETTLED", "information < SETTLED"),
        (".clamp_min(LEAST)", ""),
    ],
    ("tracking/safeguards/scale_drift.py", "tracking/safeguards/test_scale_drift.py"): [
        ("(-drift).exp()", "drift.exp()"),
        ("(drift[1:] + drift[:-1]) / 2", "drift[1:]"),
        ("drift - drift.mean()", "drift"),
        ("SLOW_ERROR**2 + noise", "0 * noise"),
        ("log_ratio[told].diff()", "0 * log_ratio[told]"),
        ("-0.5 * ((position", "-5.0 * ((position"),
    ],
    ("tracking/safeguards/motion_memory.py",
     "tracking/safeguards/test_motion_memory_overlay.py"): [
        ("counts & (flow < STANDS)", "flow < STANDS"),
        ("> MOVES", "> 0"),
        (">= ALWAYS", "> 0"),
        ("len(still) < MIN_PAIRS", "not still"),
        ("*grid.shape), 3, 1, 1)", "*grid.shape), 1, 1, 0)"),
    ],
    ("tracking/safeguards/pose_support.py", "tracking/safeguards/test_pose_support.py"): [
        ("fits[index].support < LOST_SUPPORT", "fits[index].support < 0 *"),
        ("key=lambda fit: fit.support", "key=lambda fit: -fit.support"),
    ],
    ("tracking/safeguards/first_frame.py", "tracking/safeguards/test_first_frame.py"): [
        ("lost >= len(followed)", "lost > len(followed)"),
    ],
    ("mapping/safeguards.py", "mapping/test_safeguards.py"): [
        ("[weight > 0].sum()", ".sum()"),
        ("[weight > 0].sum()", "[weight == 0].sum()"),
    ],
    ("mapping/mapper.py", "mapping/test_safeguards.py"): [
        ("if static.any():", "if True:"),
        ("self._remove_unsupported()", "pass"),
        ("static >= LEAST_STATIC * whole", "static < LEAST_STATIC * whole"),
    ],
    ("tracking/safeguards/diagnostics.py", "tracking/safeguards/test_diagnostics.py"): [
        ("weak >= LONG or _is", "_is"),
        ("or held < MIN_CONTINUITY", ""),
        ("or agreement < MIN_AGREEMENT", ""),
        ("matched * fits[i, keyframe]", "matched"),
        ("known[i] * graph.links.conf", "graph.links.conf"),
        ("fitted * graph.keyframes.motion_weights[i]", "fitted"),
        ("matched * graph.keyframes.static_weights[i]", "matched"),
        ("max(holding)", "min(holding)"),
        ("min(agreeing,", "max(agreeing,"),
        ("index - last <= HEALED_AFTER", "False"),
        ("if target == source + 1", "if target == source - 9"),
        ("turned, POSE_ITERATIONS", "turned, 0"),
        ("for kernel in (None, *kernels)", "for kernel in (None,)"),
        ("BundleState(poses, grid.rays.new_zeros(", "BundleState(poses, grid.rays.new_ones("),
        ("/ graph.pixel_scale if known", "if known"),
    ],
    ("tracking/disparity_prior.py", "tracking/test_disparity_prior.py"): [
        ("(depth > 0) & (warped > 0)", "(warped > 0)"),
        ('"amin"', '"amax"'),
        ("counts.consistent < ", "counts.consistent <= "),
    ],
    ("tracking/frame_graph.py", "tracking/test_frame_graph.py"): [
        ("ratio >= KEPT_FRACTION *", "ratio >= 0 *"),
        ("(without_rotation, 1 - rotation_weight)", "(without_rotation, rotation_weight)"),
        ("min(abs(i - j) - 2, suppression)", "suppression"),
    ],
    ("stereo/aggregation.py", "stereo/test_aggregation.py"): [
        ("before[:, :-1] + STEP_COST", "before[:, :-1]"),
        ("0.5 * (left - right)", "0.5 * (right - left)"),
    ],
    ("stereo/votes.py", "stereo/test_votes.py"): [
        ("expected - 2 * tolerance", "expected"),
        ("& (other.cost.take(place) < WELL_MATCHED)", ""),
    ],
    ("evaluation/images.py", "evaluation/test_images_separability.py"): [
        ('("left", "right")', '("left", "left")'),
    ],
    ("evaluation/images.py", "evaluation/test_images_depth.py"): [
        ("scale * depth - reference", "depth - reference"),
    ],
    ("evaluation/trajectory.py", "evaluation/test_trajectory.py"): [
        ("<= max_difference", "<= 2 * max_difference"),
    ],
    ("data/sources.py", "data/test_sources.py"): [
        ("self.promised > len(self) > 1", "len(self) > 1"),
    ],
    ("data/checkpoint.py", "data/test_checkpoint.py"): [
        ("allow_pickle=False", "allow_pickle=True"),
    ],
    ("data/run_folder.py", "data/test_run_folder.py"): [
        ("fcntl.LOCK_EX |", "fcntl.LOCK_SH |"),
    ],
    ("runs/run.py", "runs/test_run_ending.py"): [
        ("if slam.lost_frames() or slam.sequence.lost:", "if False:"),
        ("2 * adjustments.failed > adjustments.count", "adjustments.failed > adjustments.count"),
        ("if slam.tracker.watch.breaks:", "if False:"),
    ],
    ("runs/facts.py", "runs/test_facts.py"): [
        ("keyframe.exposed(rendering.color), keyframe", "rendering.color, keyframe"),
        ("keyframe.image, static\n", "keyframe.image, None\n"),
        ("if static.any() else None", "if True else None"),
        ("seen < LEAST_BEYOND_TURNS", "seen < 0"),
        ("2 * without >= len", "2 * without < len"),
        ("not fit.is_doubtful or is_broken", "fit.is_doubtful or is_broken"),
    ],
    ("viz/report.py", "viz/test_report.py"): [
        ("name: escape(getattr(report, name))", "name: getattr(report, name)"),
        ('class="warning">{escape(text)}', 'class="warning">{text}'),
    ],
}  # fmt: skip
# Mutants that change nothing, each with the reason.
EQUIVALENT: dict[tuple[str, str], str] = {}


def verdict(scratch: Path, name: str, tests: str, old: str, new: str) -> str:
    """Return how the tests answer a mutant: killed, survived, stale or void.

    Stale: the line is gone. Void: the tests fail without the mutant as well.
    """
    path = scratch / "minislam" / name
    whole = path.read_text(encoding="utf-8")
    if old not in whole:
        return "stale"
    if not passes(scratch, tests):
        return "void"  # they fail without the mutant as well
    path.write_text(whole.replace(old, new, 1), encoding="utf-8")
    try:
        return "survived" if passes.__wrapped__(scratch, tests) else "killed"
    finally:
        path.write_text(whole, encoding="utf-8")


@cache
def passes(scratch: Path, tests: str) -> bool:
    """Tell whether tests pass, in a process that has imported the large packages already."""
    child = os.fork()
    if child == 0:
        os._exit(_tested(scratch, tests.split()))
    return os.waitpid(child, 0)[1] == 0


def _tested(scratch: Path, tests: list[str]) -> int:
    """Run tests in this process, which is a copy; return 0 if they all pass."""
    signal.alarm(ALARM)
    torch.set_num_threads(1)
    os.chdir(scratch)
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        files = [str(scratch / "tests" / name) for name in tests]
        return int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", "-p", "no:nbmake", *files,
                                "-o", "addopts=--import-mode=importlib"]))  # fmt: skip


def main() -> None:
    """Print one line per mutant and the score."""
    words = sys.argv[1:]
    chosen = [
        (name, tests, *change)
        for (name, tests), changes in MUTANTS.items()
        for change in changes
        if not words or any(word in name for word in words)
    ]
    sys.dont_write_bytecode = True  # the files change faster than their times
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    score: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder) / "clone"
        left_out = shutil.ignore_patterns(".git", "__pycache__", "notebooks", "output")
        shutil.copytree(ROOT, scratch, ignore=left_out)
        sys.path[:] = [str(scratch), *(entry for entry in sys.path if Path(entry or ".") != ROOT)]
        os.environ["PYTHONPATH"] = str(scratch)
        for name, tests, old, new in chosen:
            found = verdict(scratch, name, tests, old, new)
            if found == "survived" and (name, old) in EQUIVALENT:
                found = "equivalent"
            score[found] += 1
            print(f"{found:10s} {name}: {old} -> {new}", flush=True)
    print(", ".join(f"{count} {kind}" for kind, count in score.items()), f"of {len(chosen)}")


if __name__ == "__main__":
    main()
