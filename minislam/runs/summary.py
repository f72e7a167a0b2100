"""The summary of a run in words: what is known, in which unit, and whether it is good.

measures.csv beside this file names the numbers of metrics.json and says when they are healthy. Its
bounds are from tests/benchmarks/RESULTS.md: nearly all clips are good with beta; without it, or
where a run is broken, they are poor.
"""

import csv
from collections.abc import Iterator, Mapping
from importlib.resources import files
from typing import Any, NamedTuple


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
    rows = (f"  {line.what:35s}{line.value:14s} {line.verdict:6s}{line.detail}" for line in lines)
    return [row.rstrip() for row in rows]


def judge(value: float, good: float | None, fair: float | None) -> str:
    """Return good, fair or poor; nothing where there are no bounds."""
    if good is None or fair is None:
        return ""
    sign = 1 if good > fair else -1
    if sign * value >= sign * good:
        return "good"
    return "fair" if sign * value >= sign * fair else "poor"


def span(first: int, last: int) -> str:
    """Return the numbers of some frames in words."""
    return f"{first} to {last}" if first < last else str(first)


def _counted(facts: Mapping[str, Any]) -> Iterator[Line]:
    frames, lost = facts["frames"], facts["lost_frames"]
    followed = f"{frames - lost:,} of {frames:,}"
    verdict = judge(lost / max(frames, 1), 0.0, 0.1)
    yield Line("frames followed", followed, verdict, "frames with a pose; the others are lost")
    if unread := facts.get("unread_images"):
        yield Line("images left out", f"{unread:,}", "poor", "damaged, or of another size")
    if facts["breaks"]:
        where = ", ".join(span(b["first_frame"], b["last_frame"]) for b in facts["breaks"])
        yield Line("broken at frames", where, "poor", "before and after do not belong together")
    meaning = "frames that the tracker keeps; the map is fitted to them and to some between"
    yield Line("keyframes", f"{facts['keyframes']:,}", "", meaning)
    yield Line("Gaussians in the map", f"{facts['gaussians']:,}")


def _measured(metrics: Mapping[str, Any], facts: Mapping[str, Any]) -> Iterator[Line]:
    table = files("minislam.runs").joinpath("measures.csv").read_text(encoding="utf-8")
    for row in csv.DictReader(table.splitlines()):
        value = metrics.get(row["key"])
        if value is not None:
            good, fair = (float(row[name]) if row[name] else None for name in ("good", "fair"))
            unit = row["unit"].replace("of the map", facts["unit"])
            text = f"{value:.{row['digits']}f} {unit}".rstrip()
            yield Line(row["words"], text, judge(value, good, fair), row["meaning"])


def _spent(metrics: Mapping[str, Any], facts: Mapping[str, Any]) -> Iterator[Line]:
    focal, verdict = facts["focal_length"], ""
    length, _, origin = focal["used"].partition(", ")
    is_whole = not facts["breaks"] and not facts["lost_frames"]  # else it fits any focal length
    if focal.get("factor") is not None and is_whole:
        verdict = "poor" if focal["is_doubtful"] else "good"
        where = f"from frame {span(*focal['half'])} " if focal.get("half") else ""
        origin += f"; {where}the flow fits {focal['factor']:.2f} times this one best"
    yield Line("focal length", length.partition(" for ")[0], verdict, detail=origin)
    across, down = facts["readout_seconds"]
    if across or down:
        ends = ("left", "right") if across else ("top", "bottom")
        first, last = ends if across + down > 0 else ends[::-1]
        part = abs(across + down) / facts["frame_seconds"]  # stamps may count frames, not seconds
        detail = f"of a frame's time, {first} to {last}"
        yield Line("rolling shutter", f"{part:.0%}", detail=detail)
    seconds = dict(facts["seconds"])
    total = seconds.pop("total")
    stages = sorted(seconds.items(), key=lambda stage: -stage[1])
    parts = ", ".join(f"{stage} {spent:.0f} s" for stage, spent in stages if spent >= 0.5)
    yield Line("time", f"{total:.0f} s", detail=parts)
    if metrics.get("peak_memory_mb"):
        yield Line("memory at most", f"{metrics['peak_memory_mb']:.0f} MB")
