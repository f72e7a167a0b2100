"""The pictures of a run folder: keyframe images, plots, the viewer and the report."""

import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from minislam import viz
from minislam.config import PRESETS, SlamConfig, preset, settings_of
from minislam.data.files import Json, write_text
from minislam.data.images import encode_jpeg, encode_png
from minislam.data.run_folder import KEYFRAMES, PLOTS, REPORT, VIEWER, RunFolder
from minislam.evaluation import absolute_trajectory_error
from minislam.evaluation.metrics import MAX_DIFFERENCE
from minislam.mapping.mapper import surface_depth
from minislam.runs.loaded import Run
from minislam.runs.progress import quoted
from minislam.runs.resume import NO_WAY_ON, way_on
from minislam.runs.summary import summarise
from minislam.slam import Slam
from minislam.tracking.safeguards.diagnostics import MIN_EXPLAINED_LONG
from minislam.viz import figure_png

MAX_SHOWN = 150  # keyframes in report and viewer, evenly spread: 40 kB each
LONGEST_SIDE = 320  # px of their panels there
COLOUR_SAMPLES = 6  # keyframes from which the colours of all are chosen
PREVIEW_FRACTION = 0.01  # of a run's time that writing reports before its end may take [-]


class Preview:
    """Keeps a report in the folder while the run goes on, from its first map on."""

    def __init__(self, folder: RunFolder) -> None:
        self._folder = folder
        self._due = 0.0  # second, when the next one may be written

    def update(self, slam: Slam, facts_of: Callable[[str, None], Json]) -> None:
        """Write the report if there is a map and a new one is due; `facts_of` is run.json."""
        begun = time.perf_counter()
        if begun >= self._due and slam.mapper.images:
            write_preview(self._folder, slam, facts_of("running", None))
            ended = time.perf_counter()
            self._due = ended + (ended - begun) / PREVIEW_FRACTION


def write_preview(folder: RunFolder, slam: Slam, facts: Json) -> None:
    """Write the report of what is known so far; a failure to write it does not end the run."""
    with suppress(Exception):
        (panels,) = _panels(slam, [len(slam.mapper.images) - 1])
        strip = [panels["input"], viz.beta_to_rgb(panels["beta"]), panels["render"]]
        jpeg = encode_jpeg(np.concatenate(strip, axis=1), 3 * LONGEST_SIDE)
        _write_report(folder, slam, {}, facts, overview=jpeg)


def write_pictures(folder: RunFolder, slam: Slam, metrics: Json, facts: Json) -> None:
    """Write keyframe images, plots, viewer and report."""
    estimate, true_path, unit = slam.trajectory(), None, facts["unit"]
    rows, names = facts["keyframe_diagnostics"], ("frame_index", "explained", "agreement")
    frames, explained, agreement = ([row[name] for row in rows] for name in names)
    breaks = [(found["first_frame"], found["last_frame"]) for found in facts["breaks"]]
    lost = [index for index, _, _ in slam.lost_frames()]
    health = viz.keyframe_health(frames, explained, agreement, MIN_EXPLAINED_LONG, breaks, lost)
    plots = [("health", "How much of the flow poses and depths explain, by keyframe", health)]
    truth = slam.sequence.ground_truth
    if metrics["ate_all_cm"] is not None and truth is not None and truth.trajectory is not None:
        error = absolute_trajectory_error(estimate, truth.trajectory, max_difference=MAX_DIFFERENCE)
        estimate, true_path, unit = error.estimate, error.truth, "m"
        over_time = viz.ate_over_time(estimate.timestamps, error.errors, unit)
        plots += [("ate_over_time", "Error of the camera's position over time", over_time)]
    stamps = [tracked.timestamp for tracked in slam.tracker.tracked]
    broken = [(stamps[first], stamps[last]) for first, last in breaks]
    path = viz.trajectory_plot(estimate, true_path, unit, broken)
    history = slam.mapper.history
    curves = {name: values for name, values in history.items() if name != "Gaussians"}
    rise = "the first two may rise where beta begins to weigh them and at full image size"
    plots += [
        ("trajectory", "Path of the camera, in the planes x-z and x-y", path),
        ("losses", f"Losses while the map was optimised; {rise}", viz.loss_curves(curves)),
        ("gaussians", "Size of the map", viz.map_growth(history["Gaussians"])),
    ]
    figures = []
    for name, caption, figure in plots:
        figures.append((caption, figure_png(figure)))
        folder.write_image(f"{PLOTS}/{name}.png", figures[-1][1])

    shown = _write_keyframes(folder, slam)
    (middle,) = _panels(slam, [len(slam.mapper.images) // 2])
    panels = middle["input"], middle["beta"], middle["render"]
    overview = figure_png(viz.overview(*panels, estimate, true_path, unit, broken))
    folder.write_image(f"{PLOTS}/overview.png", overview)
    run = Run(folder.path)
    small = {k: (image, beta, render) for k, (image, _, beta, render) in shown["keyframes"].items()}
    scene = vars(run.gaussians), run.camera, run.background, run.poses, len(run.frames), small
    write_text(folder.path / VIEWER, viz.build_viewer(f"minislam: {run.name}", *scene))
    _write_report(folder, slam, metrics, facts, overview=overview, figures=figures, **shown)


def _write_report(folder: RunFolder, slam: Slam, metrics: Json, facts: Json, **shown: Any) -> None:
    """Write what is shown, by the names of viz.Report, and what the run tells of itself."""
    program, *arguments = facts["command"]
    by_hand = Path(program).stem in ("minislam", "__main__")  # or else by a program of the user
    words = ["minislam", *arguments] if by_hand else ["python", program]
    report = viz.Report(
        title=f"minislam: {slam.sequence.name}",
        folder=quoted(str(folder.path)),
        state=facts["state"],
        description=slam.sequence.description,
        warnings=facts["warnings"],
        summary=summarise(metrics, facts),
        unit=facts["unit"],
        command=" ".join(map(quoted, words)),
        settings=named_settings(slam.config),
        next_step=way_on(folder.path) or NO_WAY_ON,
        **shown,
    )
    write_text(folder.path / REPORT, viz.build_report(report))


def named_settings(config: SlamConfig) -> str:
    """Return the settings as the name of the nearest preset and what differs from it."""
    now, others = settings_of(config), {}
    for name in PRESETS:
        usual = settings_of(preset(name))
        others[name] = [f"{k} {v} instead of {usual[k]}" for k, v in now.items() if v != usual[k]]
    nearest = min(others, key=lambda name: len(others[name]))
    return " with ".join(filter(None, [f"preset {nearest}", ", ".join(others[nearest])]))


def _spread(count: int, most: int) -> list[int]:
    """Return at most `most` of `count` positions, the first and the last among them."""
    return sorted(set(np.linspace(0, count - 1, min(most, count)).round().astype(int).tolist()))


def _panels(slam: Slam, indices: list[int]) -> Iterator[dict[str, np.ndarray]]:
    """Yield what is shown of images of the map, depth and beta as numbers."""
    images = [slam.mapper.images[index] for index in indices]
    shown = zip(indices, images, slam.mapper.renderings(images), strict=True)
    for index, image, rendering in shown:
        yield {
            "input": image.image.cpu().numpy(),
            "depth": surface_depth(rendering).cpu().numpy(),
            "beta": slam.beta_image(index),
            "render": image.exposed(rendering.color).cpu().numpy(),
        }


def _write_keyframes(folder: RunFolder, slam: Slam) -> dict[str, Any]:
    """Write the panels of the tracker's keyframes; return small ones, and the limits of colours.

    All have the same limits. The names are those of viz.Report.
    """
    views, jpegs, written = slam.mapper.images, dict[int, list[bytes]](), set[str]()
    keyframes = [index for index, view in enumerate(views) if view.inserts]
    sample = [keyframes[k] for k in _spread(len(keyframes), COLOUR_SAMPLES)]
    sampled = list(_panels(slam, sample))
    of_depth = viz.depth_limits(np.array([panels["depth"] for panels in sampled]))
    of_beta = viz.beta_limits(np.array([panels["beta"] for panels in sampled]))
    shown = set(_spread(len(keyframes), MAX_SHOWN))
    each = zip(keyframes, _panels(slam, keyframes), strict=True)
    for number, (index, panels) in enumerate(each):
        frame_index = views[index].frame_index
        panels["depth"] = viz.depth_to_rgb(panels["depth"], of_depth)
        panels["beta"] = viz.beta_to_rgb(panels["beta"], of_beta)
        for kind, panel in panels.items():
            written.add(name := f"{KEYFRAMES}/{frame_index:06d}_{kind}.png")
            folder.write_image(name, encode_png(panel))
        if number in shown:
            jpegs[frame_index] = [encode_jpeg(panel, LONGEST_SIDE) for panel in panels.values()]
    folder.remove_other_keyframes(written)
    return {"keyframes": jpegs, "depth_limits": of_depth, "beta_limits": of_beta}
