"""The report of a run: one HTML page, filled into report.html; and a summary for a notebook."""

import json
from collections.abc import Mapping
from collections.abc import Sequence as Series
from dataclasses import dataclass, field
from html import escape
from string import Template

import numpy as np

from minislam.viz.style import beta_to_rgb, depth_to_rgb
from minislam.viz.viewer import picture_url, template

_STOPS = 9  # colours of a colour bar
_TEXTS = "title folder state description command settings next_step".split()  # of a report


@dataclass(frozen=True)
class Report:
    """What a report shows. A part that is left out is not shown."""

    title: str
    folder: str  # of the run, for the commands to type next
    state: str  # "running", "interrupted", "failed: ...", "finished", "finished, ..."
    description: str = ""  # of the sequence, one line
    warnings: Series[str] = ()
    overview: bytes = b""  # PNG or JPEG
    summary: Series[tuple[str, ...]] = ()  # what, value with unit, verdict, meaning, detail
    keyframes: Mapping[int, Series[bytes]] = field(default_factory=dict)
    # frame_index: JPEG of input, depth, beta, render
    depth_limits: tuple[float, float] = (0.0, 1.0)  # of the colours [unit]
    beta_limits: tuple[float, float] = (0.1, 1.0)
    unit: str = "world units"
    figures: Series[tuple[str, bytes]] = ()  # caption, PNG
    command: str = ""
    settings: str = ""
    next_step: str = ""  # after an interruption


def build_report(report: Report) -> str:
    """Return the HTML of a report."""
    pages = [(frame, list(map(picture_url, jpegs))) for frame, jpegs in report.keyframes.items()]
    depths = np.linspace(*report.depth_limits, _STOPS)
    betas = np.geomspace(*report.beta_limits, _STOPS)  # they are coloured by their logarithm
    return Template(template("report.html")).substitute(
        {name: escape(getattr(report, name)) for name in _TEXTS},
        kind=report.state.partition(":")[0].replace(",", ""),
        warnings="\n".join(f'<p class="warning">{escape(text)}</p>' for text in report.warnings),
        overview=picture_url(report.overview),
        summary="\n".join(_row(*line) for line in report.summary),
        keyframes=json.dumps(pages),
        depth_scale=_scale(depth_to_rgb(depths[None], report.depth_limits), depths, report.unit),
        beta_scale=_scale(beta_to_rgb(betas[None], report.beta_limits), betas, ""),
        figures="\n".join(
            f'<figure><img src="{picture_url(png)}" alt="{escape(caption)}">'
            f"<figcaption>{escape(caption)}</figcaption></figure>"
            for caption, png in report.figures
        ),
    )


def summary_html(
    title: str, lines: Series[tuple[str, ...]], warnings: Series[str], png: bytes
) -> str:
    """Return the HTML of a report's summary for a notebook: title, lines, warnings, one picture."""
    left = 'style="text-align: left"'
    rows = "".join(
        f"<tr><th {left}>{escape(what)}</th><td {left}>{escape(value)}</td>"
        f"<td {left}>{escape(verdict)}</td></tr>"
        for what, value, verdict, *_ in lines
    )
    notes = "".join(f"<p><b>Warning:</b> {escape(warning)}</p>" for warning in warnings)
    picture = f'<img src="{picture_url(png)}" alt="input, uncertainty, map, path">'
    return f"<h4>{escape(title)}</h4><table>{rows}</table>{notes}{picture}"


def _row(what: str, value: str, verdict: str, meaning: str, detail: str) -> str:
    said = f'<th>{escape(what)}</th><td class="value">{escape(value)}</td>'
    judged = f'<td class="verdict"><span class="{verdict}">{verdict}</span></td>'
    return f'<tr>{said}{judged}<td class="meaning dim">{escape(detail or meaning)}</td></tr>'


def _scale(colors: np.ndarray, values: np.ndarray, unit: str) -> str:
    """Return a colour bar (1, N, 3) with its smallest, middle and largest number."""
    stops = ", ".join(f"rgb({r:.0f} {g:.0f} {b:.0f})" for r, g, b in 255 * colors[0])
    shown = f"{values[0]:.2g}", f"{values[len(values) // 2]:.2g}", f"{values[-1]:.2g} {unit}"
    numbers = "".join(f"<span>{number}</span>" for number in shown)
    bar = f'<div class="bar" style="background:linear-gradient(to right, {stops})"></div>'
    return f'{bar}<div class="numbers">{numbers}</div>'
