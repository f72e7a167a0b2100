"""Painted surfaces with detail from millimetres to metres, and how to look them up without shimmer.

A texture is an image with a known size of one texel in metres, kept as a pyramid. A lookup blends
the two pyramid levels whose texels are about as large as the footprint of the viewing ray, so
distant surfaces are averages of their detail instead of random samples of it.
"""

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from .poses import Array

TEXEL = 0.006  # m, the finest detail of walls and furniture
FINE_TEXEL = 0.004  # m, for clothes and small things that come close to the camera
LEVELS = 5  # of the pyramid; the coarsest texel is 2^(LEVELS-1) times the finest
REMAP_COLUMNS = 1024  # cv2.remap takes images, not lists: points are laid out in such rows

Colour = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Texture:
    """An image pyramid; the surface coordinate (0, 0) lies in the middle of the image."""

    levels: tuple[Array, ...]  # each (rows, columns, 3) float32 in [0, 1]
    texel: float  # m, of the finest level

    def sample(self, across: Array, up: Array, footprint: Array) -> Array:
        """Return the colours (N, 3) at surface coordinates [m] averaged over a footprint [m]."""
        level = np.log2(np.maximum(footprint, self.texel) / self.texel).astype(np.float32)
        level = np.minimum(level, len(self.levels) - 1)
        colours = np.zeros((len(across), 3), np.float32)
        for index in range(int(level.min()), int(np.ceil(level.max())) + 1):
            weight = 1 - np.abs(level - index)
            used = np.flatnonzero(weight > 0)
            if len(used):
                looked_up = self._lookup(index, across[used], up[used])
                colours[used] += weight[used, None] * looked_up
        return colours

    def _lookup(self, index: int, across: Array, up: Array) -> Array:
        image = self.levels[index]
        texel = self.texel * 2**index
        rows, columns = image.shape[:2]
        count = len(across)
        padded = -(-count // REMAP_COLUMNS) * REMAP_COLUMNS
        flat = np.zeros((2, padded), np.float32)
        flat[0, :count] = across / texel + (columns / 2 - 0.5)
        flat[1, :count] = rows / 2 - 0.5 - up / texel
        grid = flat.reshape(2, -1, REMAP_COLUMNS)
        wrap = cv2.BORDER_WRAP
        found = cv2.remap(image, grid[0], grid[1], cv2.INTER_LINEAR, borderMode=wrap)
        return found.reshape(-1, 3)[:count]


def build_texture(image: Array, texel: float) -> Texture:
    """Return the pyramid over an image (rows, columns, 3) whose sides divide by 2^(LEVELS-1)."""
    levels = [np.clip(image, 0, 1).astype(np.float32)]
    for _ in range(LEVELS - 1):
        rows, columns = levels[-1].shape[:2]
        halved = cv2.resize(levels[-1], (columns // 2, rows // 2), interpolation=cv2.INTER_AREA)
        levels.append(halved)
    return Texture(tuple(levels), texel)


def texel_count(metres: float, texel: float) -> int:
    """Return the number of texels that cover a length and can be halved down the pyramid."""
    step = 2 ** (LEVELS - 1)
    return max(step, int(np.ceil(metres / texel / step)) * step)


def colour(hue: float, saturation: float, value: float) -> Colour:
    """Return the RGB colour of a hue [turns], saturation and value."""
    return colorsys.hsv_to_rgb(hue % 1.0, min(saturation, 1.0), min(value, 1.0))


def canvas(size: tuple[float, float], texel: float, background: Colour) -> Array:
    """Return an image of one colour, (rows, columns, 3) uint8, for a surface of size metres."""
    rows, columns = texel_count(size[1], texel), texel_count(size[0], texel)
    return np.full((rows, columns, 3), np.round(np.array(background) * 255), np.uint8)


def fractal_noise(
    rng: np.random.Generator,
    shape: tuple[int, int],
    texel: float,
    coarsest: float = 0.8,  # m
    roughness: float = 0.85,
    stretch: float = 1.0,  # along the columns, e.g. for the grain of wood
) -> Array:  # (rows, columns, 3) float32 of about unit deviation
    """Return noise with detail at every scale from `coarsest` down to one texel."""
    rows, columns = shape
    total = np.zeros((rows, columns, 3), np.float32)
    power, amplitude, scale = 0.0, 1.0, coarsest
    while scale > 0.9 * texel:
        cells = (
            max(2, round(rows * texel / scale)),
            max(2, round(columns * texel / scale / stretch)),
        )
        # Mostly grey, a little coloured: like paint, dust and wear.
        coarse = rng.standard_normal((*cells, 1), np.float32)
        coarse = 0.85 * coarse + 0.45 * rng.standard_normal((*cells, 3), np.float32)
        detail = cv2.resize(coarse, (columns, rows), interpolation=cv2.INTER_LINEAR)
        total += amplitude * detail
        power += amplitude * amplitude
        amplitude *= roughness
        scale /= 2.5
    return total / np.float32(np.sqrt(power) * 0.75)


def finish(
    rng: np.random.Generator,
    painted: Array,  # (rows, columns, 3) uint8
    texel: float,
    contrast: float,
    stretch: float = 1.0,
) -> Texture:
    """Return the texture of a painted surface with wear at all scales."""
    noise = fractal_noise(rng, painted.shape[:2], texel, stretch=stretch)
    return build_texture(painted.astype(np.float32) / 255 + contrast * noise, texel)


def scatter_patches(
    rng: np.random.Generator,
    image: Array,  # (rows, columns, 3) uint8, painted in place
    texel: float,
    palette: Sequence[Colour],
    count: int,
    extent: tuple[float, float],  # m, smallest and largest radius
) -> None:
    """Paint discs and polygons of all sizes, the large ones first."""
    rows, columns = image.shape[:2]
    smallest, largest = np.log(extent)
    radii = np.exp(rng.uniform(smallest, largest, count))
    for radius in np.sort(radii)[::-1] / texel:
        centre = rng.uniform((0, 0), (columns, rows))
        corners = int(rng.integers(3, 9))
        angles = np.linspace(0, 2 * np.pi, 24)
        if corners < 7:
            angles = np.sort(rng.uniform(0, 2 * np.pi, corners))
        outline = centre + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        shade = np.array(palette[int(rng.integers(len(palette)))]) * rng.uniform(0.75, 1.2)
        fill = np.clip(shade * 255, 0, 255).tolist()
        cv2.fillPoly(image, [np.round(outline).astype(np.int32)], fill, lineType=cv2.LINE_AA)
