"""HTML of a run and of notebooks, filled into the files beside this one: it loads nothing else.

report.html shows a run; in viewer.html, which draws the Gaussians with WebGL 2, its map can be
turned and its clip be played; flipbook.html plays the pictures of a notebook. A flip book has
neither ids nor a script element, only the handlers of its button and its slider, so several on a
page do not clash. Without scripts its first picture is shown.
"""

import base64
import json
from collections.abc import Mapping
from collections.abc import Sequence as Series
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from itertools import product
from string import Template

import cv2
import numpy as np

from minislam.errors import InputError
from minislam.geometry import Camera
from minislam.viz.style import beta_to_rgb, depth_to_rgb

Lines = Series[tuple[str, ...]]  # of a summary: what, value with unit, verdict, meaning, detail
_STOPS = 9  # colours of a colour bar
_TEXTS = "title folder state description command settings next_step".split()  # of a report
LARGEST = 400_000  # bytes of a flip book
_LEAST_WIDTH = 480  # px on the screen
_QUALITIES = (80, 70, 60, 45, 30)  # of WebP, the first that fits is taken
_SCALES = (1.0, 0.75, 0.5, 0.35)  # of the size, tried when no quality fits


@dataclass(frozen=True)
class Report:
    """What a report shows. A part that is left out is not shown."""

    title: str
    folder: str  # of the run, for the commands to type next
    state: str  # "running", "interrupted", "failed: ...", "finished", "finished, ..."
    description: str = ""  # of the sequence, one line
    warnings: Series[str] = ()
    overview: bytes = b""  # PNG or JPEG
    summary: Lines = ()
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
    is_flawed = report.state.startswith("finished,")  # the flaw's own words may name other classes
    return Template(template("report.html")).substitute(
        {name: escape(getattr(report, name)) for name in _TEXTS},
        kind="finished flawed" if is_flawed else report.state.partition(":")[0],
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


def summary_html(title: str, lines: Lines, warnings: Series[str], png: bytes) -> str:
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


def build_viewer(
    title: str,
    gaussians: Mapping[str, np.ndarray],  # raw values by name, as in GaussianArrays
    camera: Camera,  # of the images that the map was made from
    background: np.ndarray,  # (3,) RGB in [0, 1]
    poses: Mapping[int, np.ndarray],  # frame_index: T_world_camera (4, 4), of the frames in the map
    frame_count: int,
    keyframes: Mapping[int, tuple[bytes, bytes, bytes]],  # frame_index: JPEG of input, beta, render
) -> str:
    """Return the HTML of the viewer, which opens where the first camera stood.

    Centres are stored as float32, shapes as float16, colours and opacities as bytes: 30 bytes a
    Gaussian. A float16 is wrong by 0.05 %: the edge of a splat 100 px wide moves by 0.03 px.
    """
    quats = gaussians["quats_wxyz"]
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    opacities = 1 / (1 + np.exp(-gaussians["opacity_logits"].astype(np.float64)))
    colors = np.concatenate([gaussians["colors"], opacities[:, None]], axis=1)
    data = {
        "title": title,
        "camera": vars(camera),
        "background": [round(float(channel), 4) for channel in np.clip(background, 0, 1)],
        "count": len(gaussians["means"]),
        "means": _base64(gaussians["means"].astype("<f4")),
        "scales": _base64(np.exp(gaussians["log_scales"]).clip(6e-8, 6e4).astype("<f2")),
        "quats": _base64(quats.astype("<f2")),
        "colors": _base64(np.round(255 * np.clip(colors, 0, 1)).astype(np.uint8)),
        "frame_count": frame_count,
        "frames": [
            [index, np.round(pose[:3].astype(float), 6).ravel().tolist()]
            for index, pose in sorted(poses.items())
        ],
        "keyframes": {index: list(map(picture_url, jpegs)) for index, jpegs in keyframes.items()},
    }
    # "<" could end the script element that holds the data.
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    return template("viewer.html").replace("/*DATA*/", text)


@dataclass(frozen=True)
class Page:
    """A whole HTML page, shown inside a notebook's cell."""

    html: str = field(repr=False)
    height: int  # px

    def _repr_html_(self) -> str:
        """Return the page in a frame of its own, so that its styles stay inside."""
        look = f'width="100%" height="{self.height}" style="border: 0"'
        return f'<iframe srcdoc="{escape(self.html)}" {look}></iframe>'


@dataclass(frozen=True)
class FlipBook:
    """The HTML of a flip book; a notebook shows it."""

    html: str = field(repr=False)

    def _repr_html_(self) -> str:
        return self.html


def flipbook(
    pictures: Series[np.ndarray],  # each (H, W, 3) RGB, uint8 or in [0, 1], all of one size
    captions: Series[str] | None = None,  # one for each picture; None: its number
    frames_per_second: float = 8.0,
) -> FlipBook:
    """Return a player of pictures, below 400 kB: button, slider and caption.

    The pictures lose quality, then size, until they fit. InputError names what cannot be shown.
    """
    images = [_bytes_of(picture) for picture in pictures]
    if not images or any(image.shape != images[0].shape for image in images):
        raise InputError(f"expected pictures of one size, found {[i.shape for i in images]}")
    count = len(images)
    texts = [f"{n + 1} of {count}" for n in range(count)] if captions is None else list(captions)
    if len(texts) != count:
        raise InputError(f"expected one caption for each of {count} pictures, found {len(texts)}")
    for scale, quality in product(_SCALES, _QUALITIES):
        urls: list[str] = []
        while len(urls) < count and sum(map(len, urls)) < LARGEST:
            small = cv2.resize(images[len(urls)], None, None, scale, scale, cv2.INTER_AREA)
            webp = cv2.imencode(".webp", small[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, quality])[1]
            urls.append(picture_url(webp.tobytes()))
        book = json.dumps({"pictures": urls, "captions": texts}, separators=(",", ":"))
        html = Template(template("flipbook.html")).substitute(
            book=escape(book), width=max(images[0].shape[1], _LEAST_WIDTH), picture=urls[0],
            caption=escape(texts[0]), last=len(urls) - 1, interval=round(1000 / frames_per_second),
            most=max(map(len, texts)),
        )  # fmt: skip
        if len(urls) == count and len(html.encode()) < LARGEST:
            return FlipBook(html)
    raise InputError(f"expected pictures that fit into 400 kB, found {count}: show fewer of them")


def _bytes_of(picture: np.ndarray) -> np.ndarray:  # (H, W, 3) uint8
    picture = np.asarray(picture)
    if picture.ndim != 3 or picture.shape[2] != 3:
        raise InputError(f"expected pictures of the shape (H, W, 3), found {picture.shape}")
    if picture.dtype == np.uint8:
        return picture
    return np.round(255 * np.clip(np.nan_to_num(picture), 0, 1)).astype(np.uint8)


def template(name: str) -> str:
    """Return an HTML file of this package."""
    return files("minislam.viz").joinpath(name).read_text(encoding="utf-8")


def picture_url(picture: bytes) -> str:
    """Return a PNG, JPEG or WebP as a data URL, which holds the picture itself."""
    kind = {b"\x89PNG": "png", b"RIFF": "webp"}.get(picture[:4], "jpeg")
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode()}"


def _base64(values: np.ndarray) -> str:
    return base64.b64encode(values.tobytes()).decode()
