"""What things are covered with: wallpaper, planks, books, posters, rugs, cloth."""

from collections.abc import Sequence

import cv2
import numpy as np

from .poses import Array
from .textures import (
    FINE_TEXEL,
    TEXEL,
    Colour,
    Texture,
    build_texture,
    canvas,
    colour,
    finish,
    fractal_noise,
    scatter_patches,
)

Size = tuple[float, float]  # m, across and up


def _fill(
    image: Array, column: float, row: float, width: float, height: float, paint: Colour
) -> None:
    """Paint an axis-aligned rectangle given in texels."""
    corner = (round(column), round(row))
    opposite = (round(column + width) - 1, round(row + height) - 1)
    cv2.rectangle(image, corner, opposite, (np.clip(paint, 0, 1) * 255).tolist(), cv2.FILLED)


def wallpaper(rng: np.random.Generator, size: Size, palette: Sequence[Colour]) -> Texture:
    """Paint a wall: broad stripes, a printed motif and wear."""
    base = np.array(palette[0])
    image = canvas(size, TEXEL, palette[0])
    rows, columns = image.shape[:2]
    stripe = rng.uniform(0.25, 0.45) / TEXEL
    for index in range(0, int(columns / stripe) + 1, 2):
        _fill(image, index * stripe, 0, stripe, rows, tuple(base * 0.88))
    scatter_patches(rng, image, TEXEL, palette, int(26 * size[0] * size[1]), (0.015, 0.2))
    _fill(image, 0, rows - 0.1 / TEXEL, columns, 0.1 / TEXEL, tuple(base * 0.45))
    return finish(rng, image, TEXEL, contrast=0.055)


def plaster(rng: np.random.Generator, size: Size, base: Colour) -> Texture:
    """Paint a nearly bare wall: soft stains, little for a tracker to hold on to."""
    image = canvas(size, TEXEL, base)
    return finish(rng, image, TEXEL, contrast=0.012)


def planks(rng: np.random.Generator, size: Size, base: Colour, width: float = 0.13) -> Texture:
    """Paint boards that run across, each with its own tone, grain and end joints."""
    image = canvas(size, TEXEL, base)
    rows, columns = image.shape[:2]
    board = width / TEXEL
    for row in np.arange(0, rows, board):
        column = -rng.uniform(0, 0.9) / TEXEL
        while column < columns:
            length = rng.uniform(0.5, 1.4) / TEXEL
            tone = np.array(base) * rng.uniform(0.65, 1.25) * rng.uniform(0.94, 1.06, 3)
            _fill(image, column, row, length, board, tuple(np.array(base) * 0.3))
            _fill(image, column + 1, row + 1, length - 1, board - 1, tuple(tone))
            column += length
    return finish(rng, image, TEXEL, contrast=0.07, stretch=6.0)


def books(rng: np.random.Generator, size: Size, palette: Sequence[Colour]) -> Texture:
    """Paint shelves filled with books that carry labels."""
    image = canvas(size, TEXEL, (0.16, 0.11, 0.08))
    rows, columns = image.shape[:2]
    shelf = 0.32 / TEXEL
    for bottom in np.arange(rows, 0, -shelf):
        column = 2.0
        while column < columns - 2:
            width = rng.uniform(0.022, 0.055) / TEXEL
            height = shelf * rng.uniform(0.62, 0.88)
            tone = np.array(palette[int(rng.integers(len(palette)))]) * rng.uniform(0.6, 1.2)
            top = bottom - 3 - height
            _fill(image, column, top, width, height, tuple(tone))
            label = top + height * rng.uniform(0.15, 0.6)
            _fill(image, column + 1, label, width - 2, height * 0.15, tuple(tone * 0.4 + 0.55))
            column += width + (rng.uniform(0.03, 0.1) / TEXEL if rng.random() < 0.08 else 1)
        _fill(image, 0, bottom - 3, columns, 3, (0.45, 0.32, 0.2))
    return finish(rng, image, TEXEL, contrast=0.03)


def poster(rng: np.random.Generator, size: Size, palette: Sequence[Colour]) -> Texture:
    """Paint a framed picture: bold figures above lines of unreadable print."""
    image = canvas(size, FINE_TEXEL, palette[int(rng.integers(len(palette)))])
    rows, columns = image.shape[:2]
    scatter_patches(rng, image, FINE_TEXEL, palette, int(160 * size[0] * size[1]), (0.01, 0.16))
    line = 0.03 / FINE_TEXEL
    for row in np.arange(0.78 * rows, 0.94 * rows, 1.6 * line):
        column = 0.08 * columns
        while column < 0.88 * columns:
            word = rng.uniform(0.02, 0.09) / FINE_TEXEL
            _fill(image, column, row, min(word, 0.92 * columns - column), line, (0.95, 0.93, 0.88))
            column += word + 0.015 / FINE_TEXEL
    frame = max(2, round(0.022 / FINE_TEXEL))
    cv2.rectangle(image, (0, 0), (columns - 1, rows - 1), (40, 30, 25), 2 * frame)
    return finish(rng, image, FINE_TEXEL, contrast=0.03)


def rug(rng: np.random.Generator, size: Size, palette: Sequence[Colour]) -> Texture:
    """Paint a woven rug: nested borders, a field of lozenges, thick yarn."""
    image = canvas(size, TEXEL, palette[0])
    rows, columns = image.shape[:2]
    for ring, inset in enumerate((0.0, 0.06, 0.13, 0.17, 0.26)):
        margin = inset / TEXEL
        tone = palette[(ring + 1) % len(palette)]
        _fill(image, margin, margin, columns - 2 * margin, rows - 2 * margin, tone)
    step = 0.16 / TEXEL
    reach = 0.45 * step * np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    for row in np.arange(0.3 / TEXEL, rows - 0.25 / TEXEL, step):
        for column in np.arange(0.3 / TEXEL, columns - 0.25 / TEXEL, step):
            yarn = np.array(palette[int(rng.integers(len(palette)))]) * 255
            for scale in (1.0, 0.45):
                outline = np.round((column, row) + scale * reach).astype(np.int32)
                cv2.fillPoly(image, [outline], (yarn * scale).tolist(), lineType=cv2.LINE_AA)
    return finish(rng, image, TEXEL, contrast=0.06)


def furniture(rng: np.random.Generator, base: Colour) -> Texture:
    """Paint worn wood or lacquer with panels, stains and stickers."""
    image = canvas((1.2, 1.2), TEXEL, base)
    tones = [tuple(np.array(base) * factor) for factor in (0.6, 0.8, 1.2, 1.4)]
    scatter_patches(rng, image, TEXEL, tones, 100, (0.012, 0.12))
    return finish(rng, image, TEXEL, contrast=0.06, stretch=3.0)


def cloth(
    rng: np.random.Generator, base: Colour, accent: Colour, pattern: str, size: float = 0.77
) -> Texture:
    """Paint fabric: "stripes", "plaid", "dots" or "plain", woven from fine yarn."""
    image = canvas((size, size), FINE_TEXEL, base)
    rows, columns = image.shape[:2]
    if pattern in ("stripes", "plaid"):
        step = rows / round(rows * FINE_TEXEL / rng.uniform(0.07, 0.11))
        for position in np.arange(0, rows, step):
            _fill(image, 0, position, columns, 0.45 * step, accent)
    if pattern == "plaid":
        step = columns / round(columns * FINE_TEXEL / 0.12)
        for position in np.arange(0, columns, step):
            _fill(image, position, 0, 0.25 * step, rows, tuple(np.array(base) * 0.5))
    if pattern == "dots":
        scatter_patches(rng, image, FINE_TEXEL, [accent], 90, (0.008, 0.035))
    return finish(rng, image, FINE_TEXEL, contrast=0.07 if pattern == "plain" else 0.05)


def patched(rng: np.random.Generator, palette: Sequence[Colour], size: float = 0.64) -> Texture:
    """Paint a surface of vivid patches, for balls, bags and boxes that are carried."""
    image = canvas((size, size), FINE_TEXEL, palette[0])
    scatter_patches(rng, image, FINE_TEXEL, palette, int(260 * size * size), (0.012, 0.11))
    return finish(rng, image, FINE_TEXEL, contrast=0.04)


def segments(rng: np.random.Generator, first: Colour, second: Colour, size: float) -> Texture:
    """Paint an umbrella seen from above: eight segments of alternating colour with a border."""
    image = canvas((size, size), FINE_TEXEL, first)
    rows, columns = image.shape[:2]
    up, across = np.mgrid[0:rows, 0:columns].astype(np.float32)
    up, across = up - (rows - 1) / 2, across - (columns - 1) / 2
    angle = np.arctan2(up, across) / (2 * np.pi) * 8
    image[np.floor(angle) % 2 == 0] = np.round(np.array(second) * 255)
    radius = np.hypot(up, across) / (rows / 2)
    ring = (radius > 0.72) & (radius < 0.8)
    image[ring] = np.round(np.array(colour(0.14, 0.25, 0.95)) * 255)
    return finish(rng, image, FINE_TEXEL, contrast=0.045)


def stone(rng: np.random.Generator, base: Colour, size: float = 0.5) -> Texture:
    """Paint speckled rock."""
    image = canvas((size, size), FINE_TEXEL, base)
    noise = fractal_noise(rng, image.shape[:2], FINE_TEXEL, coarsest=0.12, roughness=0.95)
    return build_texture(image.astype(np.float32) / 255 + 0.13 * noise, FINE_TEXEL)
