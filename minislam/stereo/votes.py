"""Geometric consistency: votes of other views for or against each swept depth.

The point of a pixel is projected into another swept view. If the depth found there is the depth of
the point, the view agrees. If the view has a good match behind the point, it looks through it, and
the point is refuted. With a moving object no other view agrees, unless it stands still for a while
or moves steadily beside the camera: then views of other times refute it, which look through it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from minislam.geometry import Camera
from minislam.stereo.sweep import plane_homographies

TOLERANCE = 0.05  # relative error of the inverse depth that still agrees [-]
WELL_MATCHED = 0.5  # a view with a larger matching cost cannot refute [-]
MIN_AGREEING = 3  # views
MAX_REFUTED = 0.5  # refuting views per agreeing view of its time [-]
WINDOW = 7  # px, side of the window around a pixel
LEAST_KNOWN_AROUND = 0.4  # fraction of this window that must be known, too [-]
CONFIRMING_COST = 0.6  # a pixel with a larger matching cost confirms nothing [-]
MOST_SPREAD = 0.075  # image widths from a good match: so far aggregation may carry a depth
JUDGES = 24  # views, spread evenly over the clip, that tell what stays
SURFACE = 15  # px, side of the window in which pixels of a surface are judged together
SAME_SURFACE = 0.1  # relative difference of their inverse depths [-]
LEAST_REFUTING = 1.0  # judges, in the mean of these pixels
PER_AGREEING = 0.15  # least refuting judges per agreeing one [-]
LOOKED_THROUGH = 0.3  # refuted fraction of the small window around a pixel that may move [-]


@dataclass(frozen=True)
class SweptView:
    """What the sweep found for one image."""

    inverse_depth: np.ndarray  # (h, w) float32 1/world unit, nan where the sweep found nothing
    cost: np.ndarray  # (h, w) float32 in [0, 1], matching cost at that depth
    plane_step: float  # 1/world unit between two planes
    T_camera_world: np.ndarray  # (4, 4) float64


@dataclass(frozen=True)
class ConfirmedDepth:
    """The depths of one image that other views confirm."""

    inverse_depth: np.ndarray  # (h, w) float32 1/world unit, 0 where unknown
    # (h, w) float32: near 1, all around stands still; -1 where views of other times look through it
    confirmation: np.ndarray


def confirm(camera: Camera, view: SweptView, others: list[SweptView]) -> ConfirmedDepth:
    """Keep the depths of a view on which enough other views agree, and which few refute."""
    agreeing, refuting = count_votes(camera, view, others)
    needed = min(MIN_AGREEING, len(others))
    known = (agreeing >= max(1, needed)) & (refuting < MAX_REFUTED * agreeing)
    known &= _fraction_around(known) >= LEAST_KNOWN_AROUND
    static = known & (view.cost < CONFIRMING_COST)
    known &= _distance(static) <= MOST_SPREAD * camera.width  # beyond, a guess has spread
    return ConfirmedDepth(np.where(known, view.inverse_depth, 0), _fraction_around(static))


def keep_what_stays(
    camera: Camera,
    views: list[SweptView],  # in the order of time
    depths: list[ConfirmedDepth],  # of the views
    wanted: list[int],  # positions of views
) -> Iterator[ConfirmedDepth]:  # of the wanted views
    """Drop, by confirmed depths, what views of other times look through; trust fades around it."""

    def confirmed_view(index: int) -> SweptView:
        inverse_depth, cost = depths[index].inverse_depth, 1 - depths[index].confirmation
        inverse_depth = np.where(inverse_depth > 0, inverse_depth, np.nan)
        return replace(views[index], inverse_depth=inverse_depth, cost=cost)

    judging = {index: confirmed_view(index) for index in evenly(len(views), JUDGES)}
    for index in wanted:
        depth = depths[index]
        others = [view for judge, view in judging.items() if judge != index]
        agreeing, refuting = count_votes(camera, confirmed_view(index), others)
        refuted = _is_looked_through(depth.inverse_depth, agreeing, refuting)
        known = (depth.inverse_depth > 0) & ~refuted
        fraction = _fraction_around(refuted)
        confirmation = depth.confirmation * np.maximum(1 - 2 * fraction, 0)
        confirmation[~known & (fraction > LOOKED_THROUGH)] = -1
        known &= _fraction_around(known) >= LEAST_KNOWN_AROUND
        yield ConfirmedDepth(np.where(known, depth.inverse_depth, 0), confirmation)


def _distance(mask: np.ndarray) -> np.ndarray:  # (h, w) bool -> (h, w) float32 px
    """Return how far each pixel is from the nearest one that the mask holds; inf without any."""
    if not mask.any():
        return np.full(mask.shape, np.inf, np.float32)
    return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)


def _fraction_around(mask: np.ndarray) -> np.ndarray:  # (h, w) bool -> (h, w) float32
    """Return the fraction of the window around each pixel in which the mask is true."""
    return cv2.blur(mask.astype(np.float32), (WINDOW, WINDOW))


def _is_looked_through(
    inverse_depth: np.ndarray,  # (h, w) 1/world unit, 0 where unknown
    agreeing: np.ndarray,  # (h, w) judges
    refuting: np.ndarray,
) -> np.ndarray:  # (h, w) bool
    """Tell which pixels are refuted, on average over the surface around each of them."""
    square = np.ones((SURFACE, SURFACE), np.uint8)
    agreeing, refuting = agreeing.astype(np.uint8), refuting.astype(np.uint8)
    doubted = (inverse_depth > 0) & (cv2.dilate(refuting, square) > 0)
    padded = (np.pad(a, SURFACE // 2) for a in (inverse_depth, agreeing, refuting))
    depths, *votes = (sliding_window_view(a, square.shape)[doubted] for a in padded)
    own = inverse_depth[doubted, None, None]
    same = np.abs(depths - own) < SAME_SURFACE * own
    agreeing, refuting = ((same * a).sum((1, 2)) / same.sum((1, 2)) for a in votes)
    result = np.zeros_like(doubted)
    result[doubted] = refuting >= np.maximum(LEAST_REFUTING, PER_AGREEING * agreeing)
    return result


def evenly(count: int, most: int) -> list[int]:
    """Return at most `most` of `count` positions, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int)).tolist()


def count_votes(
    camera: Camera, view: SweptView, others: list[SweptView]
) -> tuple[np.ndarray, np.ndarray]:  # 2 x (h, w)
    """Return how many views agree with each depth of a view, and how many refute it."""
    votes, none = [vote(camera, view, other) for other in others], np.zeros_like(view.cost)
    return sum((agrees for agrees, _ in votes), none), sum((refutes for _, refutes in votes), none)


def vote(camera: Camera, view: SweptView, other: SweptView) -> tuple[np.ndarray, np.ndarray]:
    """Return where another view agrees with the depths of this one, and where it refutes them.

    Both are (h, w) bool; a point outside the other image is neither agreed with nor refuted.
    """
    height, width = view.cost.shape
    motion = other.T_camera_world @ np.linalg.inv(view.T_camera_world)
    # Each pixel p lies on a plane of its own, and H(q) p = H(0) p + q K t is linear in q.
    at_infinity, at_one = plane_homographies(camera, motion, np.array([0.0, 1.0]))
    parallax = (at_one - at_infinity)[:, 2].astype(np.float32)
    at_infinity = at_infinity.astype(np.float32)
    column, row = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
    x, y, z = (
        (H[0] * column + (H[1] * row + H[2])) + view.inverse_depth * t
        for H, t in zip(at_infinity, parallax, strict=True)
    )
    in_front = z > 1e-3
    z = np.where(in_front, z, 1)
    u, v = x / z, y / z
    inside = in_front & (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    row, column = np.rint(np.where(inside, v, 0)), np.rint(np.where(inside, u, 0))
    place = (row * width + column).astype(np.int32)
    expected = view.inverse_depth / z
    found = other.inverse_depth.take(place)
    tolerance = np.maximum(TOLERANCE * expected, max(view.plane_step, other.plane_step))
    agrees = inside & (np.abs(found - expected) < tolerance)
    behind = found < expected - 2 * tolerance
    return agrees, inside & behind & (other.cost.take(place) < WELL_MATCHED)
