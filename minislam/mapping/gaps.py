"""Fill static surfaces whose depth no view could measure, such as a plain road or ceiling: ours.

By half of the refinement, the MLP has learned what moves. What it calls static and the map leaves
transparent then gets the depth of its surroundings, continued as a thin plate, which bends least:
1/depth is linear over a plane, so a road goes on to the border of the image. Between a table and
the wall behind it, that is the depth of neither and would float in other views, which vote.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import torch
from scipy import sparse
from scipy.sparse import linalg
from torch import Tensor

from minislam.geometry import Camera
from minislam.mapping.insertion import nearest_pixels
from minislam.records import MapImage

CELL = 4  # px, side of the cells that are solved for: the depth of a gap is smooth
VOTERS = 48  # most images of the map that vote, evenly spread; at least 24 of more than 48
STIFFNESS = 10.0  # of what holds the plate at a known cell, over its own [-]
FREE = 1e-9  # of what holds it at the mean elsewhere, where known cells leave it free to tilt [-]
OUTLIERS = (0.02, 0.98)  # quantiles of the known 1/depth
WITHIN = (0.5, 1.5)  # of these quantiles: the plate is cut off beyond [-]
MUCH_NEARER = 0.5  # of the distance from which an image guesses a depth [-]
SAME_DEPTH = 0.1  # relative difference from a depth that is known there [-]
SAME_COLOR = 0.25  # largest difference of a colour, of which 1 is white [-]
LEAST_DIFFERING = 3  # views that see another colour


def filled_depth(depth: Tensor) -> Tensor:
    """Return depth (H, W) whose gaps (0) are filled from around them; with no depth, as it is."""
    height, width = depth.shape
    known = (depth > 0).float().cpu().numpy()
    inverse = torch.where(depth > 0, 1 / depth, 0).cpu().numpy()
    size = -(-width // CELL), -(-height // CELL)
    covered, mean = (cv2.resize(a, size, None, 0, 0, cv2.INTER_AREA) for a in (known, inverse))
    if not covered.any():
        return depth
    values, found = mean / np.maximum(covered, 1e-6), covered > 0
    cells = plate(values, found).clip(*np.quantile(values[found], OUTLIERS) * WITHIN)
    smooth = torch.from_numpy(cv2.resize(cells, (width, height))).to(depth)
    return torch.where(depth > 0, depth, 1 / smooth)


def is_refuted(
    means: Tensor,  # (N, 3) world units, of what an image inserts
    colors: Tensor,  # (N, 3), as bright as the map
    camera: Camera,
    own: MapImage,
    images: Sequence[MapImage],
) -> Tensor:  # (N,) bool
    """Tell which points that fill gaps are refuted, by the depths or by the colours of other views.

    Depths refute only a guess, a point where its own image has no depth. Either more views
    know a surface behind it, which it would hide, than one at its depth. Or a view sees it from
    less than half the distance: it would cover much there, and that view can guess the place
    itself. Colours refute any point, such as a rim with the depth of another surface, if most views
    in which nothing known hides it, and at least LEAST_DIFFERING, have another colour there.
    """
    own_z, row, column, _ = nearest_pixels(means, camera, own.T_camera_world)
    is_guessed = own.depth[row, column] == 0
    depth_votes, color_votes = torch.zeros_like(row), torch.zeros_like(row)
    is_near, differing = torch.zeros_like(is_guessed), torch.zeros_like(row)
    for image in images[:: math.ceil(len(images) / VOTERS)]:
        z, row, column, inside = nearest_pixels(means, camera, image.T_camera_world)
        known = image.depth[row, column]
        beyond = (known - z) / z
        depth_votes += (inside & (beyond > SAME_DEPTH)).long()
        depth_votes -= (inside & (beyond.abs() <= SAME_DEPTH)).long()
        is_near |= inside & (z < MUCH_NEARER * own_z)
        is_seen = inside & ((known == 0) | (beyond >= -SAME_DEPTH))
        seen = replace(image, pixels=image.pixels[row, column]).levelled
        differs = (seen - colors).abs().amax(1) > SAME_COLOR
        differing += (is_seen & differs).long()
        color_votes += (is_seen & differs).long() - (is_seen & ~differs).long()
    looks_otherwise = (color_votes > 0) & (differing >= LEAST_DIFFERING)
    return is_guessed & ((depth_votes > 0) | is_near) | looks_otherwise


def plate(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the plate (h, w) that bends least, sprung to the known values (Terzopoulos 1983)."""
    # It has the least sum of f_xx^2 + f_yy^2 + 2 f_xy^2, by differences of cells.
    height, width = values.shape
    across, down = (partial(differences, n) for n in (width, height))
    pairs = (down(0), across(2)), (down(2), across(0)), (math.sqrt(2) * down(1), across(1))
    bending = sparse.vstack([sparse.kron(*pair) for pair in pairs])
    held = np.where(known, STIFFNESS, FREE).ravel()
    at = np.where(known, values, values[known].mean()).ravel()
    system = (bending.T @ bending + sparse.diags_array(held)).tocsc()
    # The order for symmetric matrices takes half the time.
    return linalg.spsolve(system, held * at, "MMD_AT_PLUS_A").reshape(height, width)


def differences(count: int, order: int) -> sparse.sparray:
    """Return the matrix of the differences of this order between `count` values in a row."""
    return sparse.csr_array(np.diff(np.eye(count), order, axis=0))
