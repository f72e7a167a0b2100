"""A flip book: pictures that a notebook plays, in one piece of HTML that needs nothing else.

The player (flipbook.html beside this file) has neither ids nor a script element, only the handlers
of its button and its slider, so several on a page do not clash. Without scripts the first is shown.
"""

import json
from collections.abc import Sequence as Series
from dataclasses import dataclass, field
from html import escape
from itertools import product
from string import Template

import cv2
import numpy as np

from minislam.errors import InputError
from minislam.viz.viewer import picture_url, template

LARGEST = 400_000  # bytes of a flip book
_LEAST_WIDTH = 480  # px on the screen
_QUALITIES = (80, 70, 60, 45, 30)  # of WebP, the first that fits is taken
_SCALES = (1.0, 0.75, 0.5, 0.35)  # of the size, tried when no quality fits


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
