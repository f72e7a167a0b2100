"""The flip book of a notebook: complete, small, the same bytes, and apart from its neighbours."""

import base64
import json
import re
from html import unescape

import cv2
import numpy as np
import pytest

from minislam.errors import InputError
from minislam.viz import figure_picture, flipbook, new_figure
from minislam.viz.pages import LARGEST

RNG = np.random.default_rng(0)
PICTURES = [np.full((12, 16, 3), shade / 4) for shade in range(4)]


def book_of(html: str) -> dict:
    return json.loads(unescape(re.search(r'data-book="([^"]*)"', html)[1]))


def decoded(url: str) -> np.ndarray:
    kind, data = url.split(",")
    assert kind == "data:image/webp;base64"
    coded = np.frombuffer(base64.b64decode(data), np.uint8)
    return cv2.imdecode(coded, cv2.IMREAD_COLOR)[..., ::-1]


# Known answers


def test_it_holds_every_picture_in_order_and_shows_the_first():
    html = flipbook(PICTURES)._repr_html_()
    book = book_of(html)
    shades = [decoded(url).mean() / 255 for url in book["pictures"]]
    np.testing.assert_allclose(shades, [0, 0.25, 0.5, 0.75], atol=0.01)
    assert f'<img src="{book["pictures"][0]}"' in html
    assert book["captions"] == ["1 of 4", "2 of 4", "3 of 4", "4 of 4"]
    assert '<input type="range" min="0" max="3" value="0"' in html


def test_red_stays_red_in_bytes_and_in_floats():
    red = np.zeros((8, 8, 3))
    red[..., 0] = 1
    for picture in (red, (255 * red).astype(np.uint8), red.astype(np.float32)):
        shown = decoded(book_of(flipbook([picture]).html)["pictures"][0]).mean((0, 1))
        assert shown[0] > 240 and shown[1:].max() < 15


def test_the_interval_is_that_of_the_rate():
    assert ", 200);" in flipbook(PICTURES, frames_per_second=5).html


def test_a_figure_becomes_a_picture_of_its_size():
    figure = new_figure((2, 1))
    figure.patch.set_facecolor((1, 0, 0))
    picture = figure_picture(figure)
    assert picture.shape == (110, 220, 3) and picture.dtype == np.uint8
    assert picture[5, 5].tolist() == [255, 0, 0]


# Identities


def test_the_same_pictures_give_the_same_bytes_without_ids_scripts_or_addresses():
    html = flipbook(PICTURES, ["a", "b", "c", "d"]).html
    assert html == flipbook(PICTURES, ["a", "b", "c", "d"]).html
    assert not re.search(r"<script|\bid=|https?:|//", html.replace("image/webp", ""))


def test_all_that_can_be_used_has_a_name():
    html = flipbook(PICTURES, ["door", "b", "c", "d"]).html
    assert re.search(r"<button[^>]*>Play</button>", html)
    assert re.search(r'<input[^>]*aria-label="Picture"[^>]*aria-valuetext="door"', html)
    assert re.search(r'<img[^>]*alt="door"', html)


def test_the_longest_caption_has_room_so_that_the_slider_keeps_its_length():
    html = flipbook(PICTURES, ["a", "a door", "", "b"]).html
    assert '<output aria-live="off" style="flex: 0 1 6ch' in html


# Degenerate input


def test_noise_loses_quality_and_size_until_it_fits():
    noise = [RNG.integers(0, 256, (60, 80, 3), dtype=np.uint8) for _ in range(45)]
    html = flipbook(noise).html
    assert 50_000 < len(html.encode()) < LARGEST
    assert len(book_of(html)["pictures"]) == 45


def test_captions_cannot_break_the_page():
    captions = ['"><script>alert(1)</script>', "&lt;", "β > 1", "'"]
    html = flipbook(PICTURES, captions).html
    assert "<script>" not in html
    assert book_of(html)["captions"] == captions


# Errors


@pytest.mark.parametrize(
    "pictures, captions, words",
    [
        ([], None, "of one size"),
        ([np.zeros((4, 4, 3)), np.zeros((4, 5, 3))], None, "of one size"),
        ([np.zeros((4, 4))], None, r"shape \(H, W, 3\)"),
        (PICTURES, ["one"], "one caption for each of 4"),
        (PICTURES, ["x" * LARGEST, "", "", ""], "show fewer"),
    ],
)
def test_what_cannot_be_shown_is_said(pictures, captions, words):
    with pytest.raises(InputError, match=words):
        flipbook(pictures, captions)
