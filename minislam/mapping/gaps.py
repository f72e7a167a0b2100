"""Fill static surfaces whose depth no view could measure, such as a plain road or ceiling: ours.

Without a depth network such a pixel has no depth, so nothing is inserted there. By half of the
refinement, the MLP has learned what moves. What it calls static and the map leaves transparent then
gets the depth of its surroundings: 1/depth is linear over a plane, and so is the solution of
Laplace's equation whose border is linear. Between a table and the wall behind it, that is the depth
of neither: from elsewhere it would float in front of what is known there, so other views vote.
"""

import math
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from scipy import sparse
from scipy.sparse import linalg
from torch import Tensor

from minislam.geometry import Camera
from minislam.mapping.insertion import nearest_pixels
from minislam.records import Keyframe

CELL = 4  # px, side of the cells that are solved for: the depth of a gap is smooth
VOTERS = 48  # most images of the map that vote, evenly spread; at least 24 of more than 48
MUCH_NEARER = 0.5  # of the distance from which a keyframe guesses a depth [-]
SAME_DEPTH = 0.1  # relative difference from a depth that is known there [-]


def filled_depth(depth: Tensor) -> Tensor:
    """Return depth (H, W) whose gaps (0) are filled from around them; with no depth, as it is."""
    height, width = depth.shape
    known = (depth > 0).float().cpu().numpy()
    inverse = torch.where(depth > 0, 1 / depth, 0).cpu().numpy()
    size = -(-width // CELL), -(-height // CELL)
    share, mean = (cv2.resize(a, size, None, 0, 0, cv2.INTER_AREA) for a in (known, inverse))
    if not share.any():
        return depth
    cells = membrane(mean / np.maximum(share, 1e-6), share > 0)
    smooth = torch.from_numpy(cv2.resize(cells, (width, height))).to(depth)
    return torch.where(depth > 0, depth, 1 / smooth)


def is_refuted(
    means: Tensor,  # (N, 3) world units, of what a keyframe inserts
    camera: Camera,
    own: Keyframe,
    keyframes: Sequence[Keyframe],  # of the map
) -> Tensor:  # (N,) bool
    """Tell which guesses, points that their own keyframe has no depth for, are refuted.

    Either more views know a surface behind a guess, which it would hide, than one at its depth. Or
    a view sees it from less than half the distance: it would cover much there, and that view can
    guess the place itself.
    """
    own_z, row, column, _ = nearest_pixels(means, camera, own.T_camera_world)
    is_guessed = own.depth[row, column] == 0
    votes, is_near = torch.zeros_like(row), torch.zeros_like(is_guessed)
    for keyframe in keyframes[:: math.ceil(len(keyframes) / VOTERS)]:
        z, row, column, inside = nearest_pixels(means, camera, keyframe.T_camera_world)
        known = keyframe.depth[row, column]
        beyond = (known - z) / z
        votes += (inside & (beyond > SAME_DEPTH)).long()
        votes -= (inside & (beyond.abs() <= SAME_DEPTH)).long()
        is_near |= inside & (z < MUCH_NEARER * own_z)
    return is_guessed & ((votes > 0) | is_near)


def membrane(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return values (h, w) in which each cell that is not known is the mean of its neighbours."""
    number = np.arange(values.size).reshape(values.shape)
    pairs = [(number[:, :-1], number[:, 1:]), (number[:-1], number[1:])]
    first, second = (
        np.concatenate([ends.ravel() for ends in side]) for side in zip(*pairs, strict=True)
    )
    upper = sparse.coo_array((np.ones(len(first)), (first, second)), shape=2 * (values.size,))
    laplacian = sparse.csgraph.laplacian(upper + upper.T).tocsr()
    filled, free = values.astype(np.float64).ravel(), ~known.ravel()
    if free.any():
        rows = laplacian[free]
        filled[free] = linalg.spsolve(rows[:, free].tocsc(), -(rows[:, ~free] @ filled[~free]))
    return filled.reshape(values.shape)
