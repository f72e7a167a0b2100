"""Relocalisation: find a lost camera among the keyframes.

The keyframes with the most similar features are tried. Keypoints are matched between the two
images; the disparities of the keyframe make them 3D points, and PnP with RANSAC gives the pose.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from minislam.geometry.distortion import camera_matrix
from minislam.geometry.se3 import make_transform, so3_exp
from minislam.priors.dense_flow import grayscale
from minislam.tracking.disparity_prior import mask_priors
from minislam.tracking.frame_graph import both_directions
from minislam.tracking.keyframe_graph import NEIGHBOURHOOD, KeyframeGraph
from minislam.tracking.optimisation import FIRST_WIDENING, adjust

CANDIDATES = 3  # keyframes that are tried for one frame
MAX_RATIO = 0.8  # of the distance to the best over the second-best descriptor (Lowe)
PNP_ERROR = 3.0  # px at 320x240, inlier distance
PNP_ITERATIONS = 300
MIN_INLIERS = 20
MIN_CELL_WEIGHT = 0.5  # a point on a dynamic object gives a wrong pose

Keypoints = tuple[np.ndarray, np.ndarray | None]  # (P, 2) px, (P, 128) uint8; None: no descriptors


@dataclass(frozen=True)
class Place:
    """The pose of a frame, found from one keyframe."""

    keyframe_index: int
    T_camera_world: Tensor  # (4, 4) float64 of the frame
    inliers: int


class Relocaliser:
    """Finds the place of a frame; keeps keyframes' mean features, and keypoints of those tried."""

    def __init__(self, graph: KeyframeGraph) -> None:
        self._graph = graph
        self._keypoints: dict[int, Keypoints] = {}
        self._summaries: list[Tensor] = []  # (C,) each

    def find(self, image: Tensor, features: Tensor, older: int | None = None) -> Place | None:
        """Return the place with most inliers: image (H, W, 3), features (h', w', C); or None.

        It is sought among the first `older` keyframes, None: among all.
        """
        seen, known = _keypoints(image), self._graph.keyframes.features[:older]
        self._summaries += map(_summary, known[len(self._summaries) :])
        similarity = torch.stack(self._summaries[: len(known)]) @ _summary(features)
        most_similar = similarity.argsort(descending=True, stable=True)[:CANDIDATES].tolist()
        places = [self._place(seen, index) for index in most_similar]
        found = [place for place in places if place is not None]
        return max(found, key=lambda place: place.inliers, default=None)

    def _place(self, seen: Keypoints, index: int) -> Place | None:
        """Return the pose from keypoint matches with one keyframe, if there are enough."""
        keyframes, grid = self._graph.keyframes, self._graph.grid
        if index not in self._keypoints:
            self._keypoints[index] = _keypoints(keyframes.frames[index].image)
        pixels, matched = _keypoint_matches(self._keypoints[index], seen)
        structure = torch.stack([keyframes.disparities[index], keyframes.cell_weights[index]], -1)
        positions = torch.from_numpy(pixels)
        # From here on on the CPU, where OpenCV finds the pose.
        sampled = grid.sample(structure[None].cpu(), positions[None])
        disparities, cell_weights = sampled[0].unbind(-1)
        usable = (disparities > 0) & (cell_weights > MIN_CELL_WEIGHT)
        if int(usable.sum()) < MIN_INLIERS:
            return None
        points = grid.camera.rays(positions) / disparities[:, None]
        cv2.setRNGSeed(0)
        try:
            found, phi, t, inliers = cv2.solvePnPRansac(
                points[usable].double().numpy(),
                matched[usable.numpy()].astype(np.float64),
                camera_matrix(grid.camera),
                None,
                iterationsCount=PNP_ITERATIONS,
                reprojectionError=PNP_ERROR * self._graph.pixel_scale,
                flags=cv2.SOLVEPNP_SQPNP,
            )
        except cv2.error:  # SQPnP raises where all points coincide
            return None
        if not found or inliers is None or len(inliers) < MIN_INLIERS:
            return None
        T_keyframe_world = keyframes.T_camera_world[index]
        rotation, translation = so3_exp(torch.from_numpy(phi[:, 0])), torch.from_numpy(t[:, 0])
        T_frame_keyframe = make_transform(rotation, translation).to(T_keyframe_world)
        return Place(index, T_frame_keyframe @ T_keyframe_world, len(inliers))


def _summary(features: Tensor) -> Tensor:  # (h', w', C) -> (C,)
    return normalize(features.flatten(0, 1).mean(0), dim=0)


def _keypoints(image: Tensor) -> Keypoints:
    """Return SIFT positions (P, 2) [px] and descriptors (P, 128) of an image (H, W, 3)."""
    keypoints, descriptors = cv2.SIFT.create().detectAndCompute(grayscale(image), None)
    positions = np.array([k.pt for k in keypoints], np.float32).reshape(-1, 2)
    return positions, None if descriptors is None else descriptors.astype(np.uint8)  # all integers


def _keypoint_matches(first: Keypoints, second: Keypoints) -> tuple[np.ndarray, np.ndarray]:
    """Return 2 x (M, 2) px, where the best match is clearly better than the second."""
    if first[1] is None or second[1] is None or min(len(first[1]), len(second[1])) < 2:
        return np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32)
    descriptors = first[1].astype(np.float32), second[1].astype(np.float32)  # five times as fast
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(*descriptors, k=2)
    clear = [best for best, other in pairs if best.distance < MAX_RATIO * other.distance]
    in_first, in_second = ([getattr(m, end) for m in clear] for end in ("queryIdx", "trainIdx"))
    return first[0][in_first], second[0][in_second]


def attach_newest(graph: KeyframeGraph, similar: int) -> bool:
    """Link a relocalised keyframe, the newest, with those around a similar one, and move it.

    Return False, and link nothing, if the flow does not confirm that both show the same place.
    """
    newest = len(graph.keyframes) - 1
    around = range(max(0, similar - NEIGHBOURHOOD), min(newest, similar + NEIGHBOURHOOD + 1))
    edges = graph.filter_confirmed(both_directions([(newest, index) for index in around]))
    if (newest, similar) not in edges:
        return False
    mask_priors(graph, edges, first=newest)
    for _ in range(graph.config.rounds):
        graph.match(edges)
        adjust(graph, newest, graph.config.iterations, widening=FIRST_WIDENING)
    return True
