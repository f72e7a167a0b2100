"""Where the picture lies in a raw image: between black bars, or the first of two that are alike."""

from dataclasses import dataclass

import cv2
import numpy as np

from minislam.data.options import MINIMUM_SIDE

Window = tuple[int, int, int, int]  # left, top, width, height px

BLACK = 24  # of 255: the brightest that a codec leaves in a black bar
BLURRED = 2  # px of the picture, beside a bar, that a codec mixes with it
# A scene that leaves less of a side is dark, not barred [-], unless both bars are alike [px].
LEAST_PICTURE, ALIKE = 0.5, 4
FADED = 0.5  # of the largest lit area: an image that shows less does not tell where bars end [-]
CAPTION = 0.5  # of the lit fraction of the brightest line: a line of a bar with a caption has less
# Between images a caption changes by less than this part of its lit fraction, and noise [-].
SAME_CAPTION, NOISE = 0.15, 0.005
SHARP = 0.8  # of the same: the first line of a picture has more, that of a round one less
LEAST_IMAGES = 4  # that tell a caption
HALF = 96  # px, side of a half of an image when it is compared with the other
COARSE = 4.0  # px of a half: what is coarser, such as the sky above a street, tells nothing
SHIFT_U, SHIFT_V = 20, 12  # px of a half: how far one is moved over the other, each way
ELSEWHERE = 6  # px of a half: places that lie farther apart, along either side, are others
LEAST_DETAIL = 1.0  # of 255, standard deviation
# Of 68 films the median over the images is at most .17, of two equal plates in a machine .33, of
# six pairs of eyes .49 to .84, of a seventh .40.
ALIKE_PICTURES = 0.42  # [-]


@dataclass(frozen=True)
class Glance:
    """What one of a few sampled images tells of the place of the picture."""

    lit: tuple[np.ndarray, np.ndarray]  # (W,), (H,) fraction of each column, row that is not black
    similarity: tuple[float, float]  # of left and right half, of upper and lower, from 0 to 1


def glance_at(image: np.ndarray) -> Glance:  # (H, W, 3) uint8
    """Look at a sampled image."""
    lit = image.max(2) > BLACK
    wide, high = (
        cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32).mean(2)
        for size in ((2 * HALF, HALF), (HALF, 2 * HALF))
    )
    halves = (wide[:, :HALF], wide[:, HALF:]), (high[:HALF], high[HALF:])
    side_by_side, stacked = (_similarity(*pair) for pair in halves)
    return Glance((lit.mean(0), lit.mean(1)), (side_by_side, stacked))


def _similarity(one: np.ndarray, other: np.ndarray) -> float:  # (HALF, HALF) each
    """Return the correlation of the details of two pictures at their best shift, less the next [-].

    So what repeats itself is not alike, such as the windows of a house, nor are bars, whose edges
    are the same all along.
    """
    one, other = (half - cv2.GaussianBlur(half, (0, 0), COARSE) for half in (one, other))
    inner = other[SHIFT_V:-SHIFT_V, SHIFT_U:-SHIFT_U]
    if min(one.std(), inner.std()) < LEAST_DETAIL:
        return 0.0
    by_shift = cv2.matchTemplate(one, inner, cv2.TM_CCOEFF_NORMED)
    best = float(by_shift.max())
    v, u = np.unravel_index(by_shift.argmax(), by_shift.shape)
    by_shift[max(v - ELSEWHERE, 0) :, max(u - ELSEWHERE, 0) :][: 2 * ELSEWHERE, : 2 * ELSEWHERE] = 0
    return best - float(by_shift.max())


def first_of_two(picture: Window, glances: list[Glance], width: int, height: int) -> Window:
    """Return the left or upper of two that are alike, as of two eyes; where one is, the same."""
    if not glances:
        return picture
    left, top, columns, rows = picture
    side_by_side, stacked = np.median([glance.similarity for glance in glances], 0)
    if side_by_side > ALIKE_PICTURES:
        columns = min(columns, width // 2 - left)
    if stacked > ALIKE_PICTURES:
        rows = min(rows, height // 2 - top)
    return (left, top, columns, rows) if min(columns, rows) >= MINIMUM_SIDE else picture


def picture_window(glances: list[Glance], width: int, height: int) -> Window:
    """Return the window that no black bar covers, as films have; a bar may carry a caption.

    In most images a bar ends at the same place, a thing on a black ground does not. Beta would
    learn that a bar is no part of the scene, and take all that is black for a part of the bar.
    """
    if not glances:  # no image could be decoded
        return 0, 0, width, height
    lit = [glance.lit for glance in glances]
    window, areas = [], np.array([columns.mean() for columns, _ in lit])
    is_bright = areas >= max(FADED * areas.max(), 1e-9)
    for axis, side in enumerate((width, height)):
        lines = _without_captions(np.stack([fractions[axis] for fractions in lit]), is_bright)
        extents = [np.flatnonzero(line)[[0, -1]] for line in lines[is_bright] if line.any()]
        first, last = np.flatnonzero(lines.any(0))[[0, -1]] if extents else (0, side - 1)
        is_steady = bool(extents) and np.abs(np.median(extents, 0) - (first, last)).max() <= ALIKE
        first, last = int(first + BLURRED * (first > 0)), int(last - BLURRED * (last < side - 1))
        are_alike = abs(first - (side - 1 - last)) <= ALIKE  # an upright film in a wide one
        least = MINIMUM_SIDE if are_alike else max(LEAST_PICTURE * side, MINIMUM_SIDE)
        is_picture = is_steady and last + 1 - first >= least
        window.append((first, last + 1 - first) if is_picture else (0, side))
    (left, width), (top, height) = window
    return left, top, width, height


def _without_captions(lines: np.ndarray, is_bright: np.ndarray) -> np.ndarray:  # (n, side)
    """Return the lit fractions of lines in n images, 0 in a bar with a caption, if it ends sharply.

    A caption lights less than half of what the picture does, and the same in all images.
    """
    if is_bright.sum() < LEAST_IMAGES:
        return lines
    most, change = lines.max(0), np.ptp(lines[is_bright], 0)
    has_caption = (most < CAPTION * most.max()) & (change <= SAME_CAPTION * most + NOISE)
    inner = most[~has_caption][BLURRED:-BLURRED]
    is_sharp = len(inner) > 0 and inner[[0, -1]].min() > SHARP * inner.max()
    return np.where(has_caption & is_sharp, 0, lines)
