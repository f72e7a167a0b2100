"""The report of a run: one HTML page, report.html its frame; and a summary for a notebook."""

import json
from collections.abc import Mapping
from collections.abc import Sequence as Series
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from string import Template

import numpy as np

from minislam.viz.style import beta_to_rgb, depth_to_rgb
from minislam.viz.viewer import picture_url

_STOPS = 9  # colours of a colour bar
_TEXTS = "title folder state description command settings".split()  # of a report


@dataclass(frozen=True)
class Report:
    """What a report shows. A part that is left out is not shown."""

    title: str
    folder: str  # of the run, for the commands to type next
    state: str  # "running", "interrupted", "failed: ...", "finished", "finished, ..."
    description: str = ""  # of the sequence, one line
    warnings: Series[str] = ()
    overview: bytes = b""  # PNG or JPEG
    summary: Series[tuple[str, str, str, str]] = ()  # what, value with unit, verdict, meaning
    keyframes: Mapping[int, Series[bytes]] = field(default_factory=dict)
    # frame_index: JPEG of input, depth, beta, render
    depth_limits: tuple[float, float] = (0.0, 1.0)  # of the colours [unit]
    beta_limits: tuple[float, float] = (0.1, 1.0)
    unit: str = "world units"
    figures: Series[tuple[str, bytes]] = ()  # caption, PNG
    command: str = ""
    settings: str = ""


def build_report(report: Report) -> str:
    """Return the HTML of a report."""
    template = files("minislam.viz").joinpath("report.html").read_text(encoding="utf-8")
    return Template(template).substitute(
        {name: escape(getattr(report, name)) for name in _TEXTS},
        kind=report.state.partition(":")[0].replace(",", ""),
        warnings="\n".join(f'<p class="warning">{escape(text)}</p>' for text in report.warnings),
        overview=picture_url(report.overview),
        summary="\n".join(_row(*line) for line in report.summary),
        keyframes=_keyframes(report) if report.keyframes else "",
        figures="\n".join(_figure(caption, png) for caption, png in report.figures),
    )


def summary_html(
    title: str,
    lines: Mapping[str, tuple[str, str]],  # what -> its value, and whether that is good
    warnings: Series[str],
    png: bytes,
) -> str:
    """Return the HTML of a small summary for a notebook: title, lines, warnings, one picture."""
    left = 'style="text-align: left"'
    rows = "".join(
        f"<tr><th {left}>{escape(what)}</th><td {left}>{escape(value)}</td>"
        f"<td {left}>{escape(verdict)}</td></tr>"
        for what, (value, verdict) in lines.items()
    )
    notes = "".join(f"<p><b>Warning:</b> {escape(warning)}</p>" for warning in warnings)
    picture = f'<img src="{picture_url(png)}" alt="input, uncertainty, map, path">'
    return f"<h4>{escape(title)}</h4><table>{rows}</table>{notes}{picture}"


def _row(what: str, value: str, verdict: str, meaning: str) -> str:
    return (
        f'<tr><th>{escape(what)}</th><td class="value">{escape(value)}</td>'
        f'<td class="verdict"><span class="{verdict}">{verdict}</span></td>'
        f'<td class="meaning dim">{escape(meaning)}</td></tr>'
    )


def _keyframes(report: Report) -> str:
    """Return the slider over the keyframes, with the scales of the colours."""
    pages = [(frame, list(map(picture_url, jpegs))) for frame, jpegs in report.keyframes.items()]
    low, high = report.beta_limits
    depths, betas = np.linspace(*report.depth_limits, _STOPS), np.geomspace(low, high, _STOPS)
    depth_rgb = depth_to_rgb(depths[None], report.depth_limits)
    beta_rgb = beta_to_rgb(betas[None], report.beta_limits)
    scales = {
        "input": "",
        "depth of the map": _scale(depth_rgb, depths, report.unit),
        "uncertainty \u03b2": _scale(beta_rgb, betas, ""),
        "static map": "",
    }
    pictures = "".join(
        f'<figure><img src="{url}" alt="{name}"><figcaption>{name}</figcaption>{scale}</figure>'
        for url, (name, scale) in zip(pages[0][1], scales.items(), strict=True)
    )
    return (
        f'<h2>Keyframes</h2><div class="four">{pictures}</div>'
        f'<input type="range" id="keyframe" min="0" max="{len(pages) - 1}" value="0" '
        f'aria-label="keyframe"><small>{len(pages)} keyframes; this one is frame '
        f'<span id="frame">{pages[0][0]}</span>. Grey depth: the map shows nothing. Bright \u03b2: '
        "something moves; from 1.4 on the map leaves it out.</small>"
        f'<script type="application/json" id="pictures">{json.dumps(pages)}</script>'
    )


def _scale(colors: np.ndarray, values: np.ndarray, unit: str) -> str:
    """Return a colour bar (1, N, 3) with its smallest, middle and largest number."""
    stops = ", ".join(f"rgb({r:.0f} {g:.0f} {b:.0f})" for r, g, b in 255 * colors[0])
    shown = f"{values[0]:.2g}", f"{values[len(values) // 2]:.2g}", f"{values[-1]:.2g} {unit}"
    numbers = "".join(f"<span>{number}</span>" for number in shown)
    return (
        f'<div class="bar" style="background:linear-gradient(to right, {stops})"></div>'
        f'<div class="numbers">{numbers}</div>'
    )


def _figure(caption: str, png: bytes) -> str:
    text = escape(caption)
    image = f'<img src="{picture_url(png)}" alt="{text}">'
    return f"<figure>{image}<figcaption>{text}</figcaption></figure>"
