"""The summary of a run in words: what is known, in which unit, and whether it is good."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple


class Measure(NamedTuple):
    """One number of metrics.json, and when it is healthy."""

    key: str
    words: str
    unit: str
    digits: int
    good: float | None  # the value from which it is good; smaller than `fair` if less is better
    fair: float | None  # the value from which the run is of use; None: there is nothing to judge
    meaning: str


# The bounds are what tests/benchmarks/RESULTS.md reports: good is what runs with beta reach on all
# clips, at least fair is better than what the same runs reach without beta, or broken ones.
MEASURES = (
    Measure("path_length", "path of the camera", "", 2, None, None,
            "from the first followed frame to the last"),
    Measure("reprojection_px", "reprojection error, median", "px", 2, 0.5, 1.0,
            "between the measured flow and that of the poses and depths"),
    Measure("parallax_px", "parallax of the keyframes, median", "px", 1, 5.0, 2.0,
            "flow by the camera's movement alone; without it there is no depth"),
    Measure("psnr_static_db", "map against input, static pixels", "dB", 1, 22.0, 18.0,
            "PSNR in the keyframes where beta says that nothing moves"),
    Measure("ate_all_cm", "position error of all frames (ATE)", "cm", 2, 3.0, 10.0,
            "root mean square against the true path, after alignment"),
    Measure("ate_keyframes_cm", "position error of the keyframes", "cm", 2, 3.0, 10.0, ""),
    Measure("ate_straight_line_cm", "error of a straight walk", "cm", 1, None, None,
            "what an answer without looking would have, for comparison"),
    Measure("psnr_novel_db", "map against unseen views", "dB", 1, 20.0, 17.0,
            "PSNR of views that the run has not seen, aligned by the camera centres"),
    Measure("ssim_novel", "the same, SSIM", "", 2, 0.6, 0.5, "structural similarity, at most 1"),
    Measure("psnr_novel_oriented_db", "the same, aligned by orientation", "dB", 1, 22.0, 18.0,
            "PSNR that measures the map rather than the alignment"),
    Measure("psnr_input_db", "map against the empty room", "dB", 1, 22.0, 18.0,
            "PSNR of the keyframes against the scene without dynamic objects"),
    Measure("psnr_masked_db", "the same behind dynamic objects", "dB", 1, 18.0, 15.0,
            "a ghost would show here"),
    Measure("lpips_novel", "map against unseen views, LPIPS", "", 3, None, None, "0 is equal"),
    Measure("lpips_input", "map against the empty room, LPIPS", "", 3, None, None, "0 is equal"),
    Measure("beta_auroc", "beta finds what moves (AUROC)", "", 3, 0.95, 0.85,
            "1 tells all moving pixels from static ones, 0.5 is chance"),
    Measure("depth_l1_cm", "depth error of the map", "cm", 1, 10.0, 30.0,
            "mean difference from the true depth, where the scene is static"),
)  # fmt: skip


class Line(NamedTuple):
    """One line of a summary."""

    what: str
    value: str  # with its unit
    verdict: str = ""  # good, fair or poor
    meaning: str = ""  # what it is; the report says it, the terminal does not
    detail: str = ""


def summarise(metrics: Mapping[str, Any], facts: Mapping[str, Any]) -> list[Line]:
    """Return what metrics.json and run.json know, without what they do not know."""
    return [*_counted(facts), *_measured(metrics, facts), *_spent(metrics, facts)]


def as_text(lines: list[Line]) -> list[str]:
    """Return the lines of a summary for a terminal, in columns."""
    return [
        f"  {line.what:35s}{line.value:14s} {line.verdict:6s}{line.detail}".rstrip()
        for line in lines
    ]


def judge(value: float, good: float | None, fair: float | None) -> str:
    """Return good, fair or poor; nothing where there are no bounds."""
    if good is None or fair is None:
        return ""
    sign = 1 if good > fair else -1
    if sign * value >= sign * good:
        return "good"
    return "fair" if sign * value >= sign * fair else "poor"


def _counted(facts: Mapping[str, Any]) -> Iterator[Line]:
    frames, lost = facts["frames"], facts["lost_frames"]
    followed = f"{frames - lost:,} of {frames:,}"
    verdict = judge(lost / max(frames, 1), 0.0, 0.1)
    yield Line("frames followed", followed, verdict, "the others have no pose")
    if facts["breaks"]:
        where = ", ".join(f"{b['first_frame']} to {b['last_frame']}" for b in facts["breaks"])
        yield Line("broken at frames", where, "poor", "before and after do not belong together")
    yield Line("keyframes", f"{facts['keyframes']:,}", "", "the frames that the map is made from")
    yield Line("Gaussians in the map", f"{facts['gaussians']:,}")


def _measured(metrics: Mapping[str, Any], facts: Mapping[str, Any]) -> Iterator[Line]:
    for measure in MEASURES:
        value = metrics.get(measure.key)
        if value is not None:
            unit = facts["unit"] if measure.key == "path_length" else measure.unit
            verdict = judge(value, measure.good, measure.fair)
            text = f"{value:.{measure.digits}f} {unit}".rstrip()
            yield Line(measure.words, text, verdict, measure.meaning)


def _spent(metrics: Mapping[str, Any], facts: Mapping[str, Any]) -> Iterator[Line]:
    focal, verdict = facts["focal_length"], ""
    length, _, origin = focal["used"].partition(", ")
    if focal.get("factor") is not None:
        verdict = "poor" if focal["is_doubtful"] else "good"
        origin += f"; the flow fits {focal['factor']:.2f} times this one best"
    yield Line("focal length", length.partition(" for ")[0], verdict, detail=origin)
    seconds = dict(facts["seconds"])
    total = seconds.pop("total")
    stages = sorted(seconds.items(), key=lambda stage: -stage[1])
    parts = ", ".join(f"{stage} {spent:.0f}" for stage, spent in stages if spent >= 0.5)
    yield Line("time", f"{total:.0f} s", detail=parts)
    if metrics.get("peak_memory_mb"):
        yield Line("memory at most", f"{metrics['peak_memory_mb']:.0f} MB")
