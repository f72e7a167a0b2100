"""The viewer of a run: one HTML page in which the map can be turned and the clip be played.

The page (viewer.html beside this file) draws the Gaussians with WebGL 2. It needs no library and
loads nothing: the map and the pictures stand in the page itself.
"""

import base64
import json
from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from importlib.resources import files

import numpy as np

from minislam.geometry import Camera


def build_viewer(
    title: str,
    gaussians: Mapping[str, np.ndarray],  # raw values by name, as in GaussianArrays
    camera: Camera,  # of the images that the map was made from
    background: np.ndarray,  # (3,) RGB in [0, 1]
    poses: Mapping[int, np.ndarray],  # frame_index: T_world_camera (4, 4), without lost frames
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

    html: str
    height: int  # px

    def _repr_html_(self) -> str:
        """Return the page in a frame of its own, so that its styles stay inside."""
        look = f'width="100%" height="{self.height}" style="border: 0"'
        return f'<iframe srcdoc="{escape(self.html)}" {look}></iframe>'


def template(name: str) -> str:
    """Return an HTML file of this package."""
    return files("minislam.viz").joinpath(name).read_text(encoding="utf-8")


def picture_url(picture: bytes) -> str:
    """Return a PNG, JPEG or WebP as a data URL, which holds the picture itself."""
    kind = {b"\x89PNG": "png", b"RIFF": "webp"}.get(picture[:4], "jpeg")
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode()}"


def _base64(values: np.ndarray) -> str:
    return base64.b64encode(values.tobytes()).decode()
