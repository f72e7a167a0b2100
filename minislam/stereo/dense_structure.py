"""Dense depth from all posed frames: which views to sweep, and from which others."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import cv2
import numpy as np
import torch
from torch import Tensor

from minislam.geometry import Camera
from minislam.images import resample
from minislam.records import Frame, MapImage, Progress, Sequence
from minislam.state.memory import SHELF
from minislam.stereo import votes
from minislam.stereo.aggregation import aggregate, refined_minimum
from minislam.stereo.sweep import PosedImage, sweep
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.pose_from_flow import filled_from_nearest
from minislam.tracking.safeguards.depth_agreement import agreed_disparities
from minislam.workers import Workers

WIDTH = 160  # px of the images that are swept for the map
VIEWS = 8  # other images in a sweep
REACH = 40  # frames to either side among which they are chosen
MAX_PARALLAX = 0.125  # image widths: with more, two images look too different
BETWEEN = 2  # most frames between two keyframes that are swept as well
RESTING = 8  # but at least one of so many: a camera at rest makes no keyframes
VOTERS = 6  # swept frames on either side that vote
DEPTH_RANGE = 1.5  # inverse depth of the nearest plane over the largest of the sparse structure
LARGEST_QUANTILE = 0.98  # of the inverse depths: the few beyond it are taken for outliers [-]
PLANES = (48, 96)  # fewest and most
FARTHEST = 0.5  # planes: what matches farther away, even at infinity, is put here
ALIKE = 0.1  # planes whose costs exceed the least one by less tell a pixel's depth no better
MOST_ALIKE = 0.5  # fraction of such planes: with more, a pixel lies on a line along the motion
LEAST_PARALLAX = 24.0  # px of the nearest plane; with less, a window matches at nearly all planes
LEAST_KNOWN = 0.5  # fraction of the pixels of all images: with less, a pan's holes are filled
LEAST_COMMON = 100  # px that have both depths; with fewer their scales are not compared
EDGE_RATIO = 1.15  # neighbouring pixels whose depths differ more lie on different surfaces


def with_swept_depth(
    camera: Camera,  # of the images
    images: list[MapImage],
    swept: Iterable[tuple[Tensor, Tensor]],  # of each, depth (H, W) and confirmation (H, W)
    fills: bool = False,  # the camera hardly did more than turn
) -> list[MapImage]:
    """Return the images with swept depth and confirmation.

    Where the sweep found nothing, the image's own depth fills in, scaled by its swept
    depth, because a network errs image by image; where other views look through it, the pixel
    stays empty. With `fills`, if less than half is known, holes take the nearest known depth.
    """
    small, judging, result = _small(camera, WIDTH), dict[int, votes.SweptView](), []
    judges = votes.evenly(len(images), votes.JUDGES)
    for index, (image, (depth, confirmation)) in enumerate(zip(images, swept, strict=True)):
        SHELF.put([depth])
        if index in judges:
            cost = 1 - _nearest(confirmation, small)
            judging[index] = _as_swept(small, depth, cost, image.T_camera_world)
        confirmation = resample(confirmation, *image.features.shape[:2])
        result.append(replace(image, depth=depth, confirmation=confirmation))
    for index, image in enumerate(images):
        if bool(image.depth.any()):
            others = [judge for at, judge in judging.items() if at != index]
            depth = _completed(small, image, result[index].depth, others)
            SHELF.put([depth])
            result[index] = replace(result[index], depth=depth)
    known = [float((image.depth > 0).float().mean()) for image in result]
    return list(map(_filled, result)) if fills and np.mean(known) < LEAST_KNOWN else result


def _completed(
    small: Camera, image: MapImage, depth: Tensor, others: list[votes.SweptView]
) -> Tensor:
    """Return swept depth (H, W), completed by the image's own where no other view refutes it."""
    both = (depth > 0) & (image.depth > 0)
    enough = int(both.sum()) > LEAST_COMMON
    guess = image.depth * ((depth / image.depth)[both].median() if enough else 1.0)
    free = np.zeros((small.height, small.width), np.float32)
    guessed = _as_swept(small, guess, free, image.T_camera_world)
    agreeing, refuting = votes.count_votes(small, guessed, others)
    moves = torch.from_numpy(refuting > votes.MAX_REFUTED * agreeing).to(depth)
    moves = resample(moves, *depth.shape) > 0.5
    return torch.where((depth > 0) | moves, depth, guess)


def _as_swept(small: Camera, depth: Tensor, cost: np.ndarray, pose: Tensor) -> votes.SweptView:
    sampled = _nearest(depth, small)
    inverse_depth = np.where(sampled > 0, 1 / np.maximum(sampled, 1e-6), np.nan)
    return votes.SweptView(inverse_depth, cost, 0.0, pose.cpu().numpy())


def _filled(image: MapImage) -> MapImage:
    """Return an image whose unknown depth is that of the nearest pixel that has one."""
    unknown = image.depth == 0
    if bool(unknown.all()) or not bool(unknown.any()):
        return image
    filled = filled_from_nearest(image.depth, unknown).reshape(unknown.shape)
    SHELF.put([filled, unknown])
    return replace(image, depth=filled, filled=unknown)


def on_backdrop(images: list[MapImage]) -> list[MapImage]:
    """Return the images of a camera that only turned, with all they see one world unit away.

    Without parallax every depth explains the images equally well, and no other view confirms any.
    """
    flat = []
    for image in images:
        one, shape = image.depth.new_ones(()), image.depth.shape
        flat.append(replace(image, depth=one.expand(shape), filled=one.bool().expand(shape)))
    return flat


def _nearest(image: Tensor, camera: Camera) -> np.ndarray:
    """Return the nearest pixels of an image (H, W) at the size of a camera."""
    size = camera.width, camera.height
    return cv2.resize(image.cpu().numpy(), size, None, 0, 0, cv2.INTER_NEAREST_EXACT)


def _small(camera: Camera, width: int) -> Camera:
    """Return the camera of the images shrunk to at most this width."""
    width = min(width, camera.width)
    return camera.resized(width, max(1, round(width * camera.height / camera.width)))


def dense_depths(
    planner: "SweepPlanner",
    frames: list[int],  # that are swept, increasing; all of them vote
    wanted: list[int],  # of these, whose depths are returned
    progress: Progress | None = None,
    workers: Workers | None = None,  # sweep side by side
) -> Iterator[tuple[Tensor, Tensor]]:
    """Return depth (H, W), 0 where unknown, and confirmation (H, W) of each wanted frame."""
    swept: list[votes.SweptView] = []
    for view in (workers or Workers()).stream(swept_view, map(planner.plan, frames)):
        images = {name: SHELF.array(getattr(view, name)) for name in ("inverse_depth", "cost")}
        swept.append(replace(view, **images))
        if progress:
            progress(len(swept), len(frames))
    depths = []
    for at, view in enumerate(swept):
        others = swept[max(0, at - VOTERS) : at] + swept[at + 1 : at + 1 + VOTERS]
        found = votes.confirm(planner.camera, view, others)
        depths.append(votes.ConfirmedDepth(*map(SHELF.array, vars(found).values())))
    positions = [frames.index(frame) for frame in wanted]
    kept = votes.keep_what_stays(planner.camera, swept, depths, positions)
    camera, device = planner.of_images, planner.device  # the images that it keeps are done with
    sized = (full_size(depth, camera) for depth in kept)
    return ((depth.to(device), confirmation.to(device)) for depth, confirmation in sized)


def swept_frames(keyframes: list[int], followed: list[int], least: int = 0) -> list[int]:
    """Return the keyframes and, of n frames between two, max(least, n // 8, min(2, n // 3))."""
    frames = set(keyframes)
    for first, last in pairwise(keyframes):
        gap = [frame for frame in followed if first < frame < last]
        usual = max(min(BETWEEN, len(gap) // 3), len(gap) // RESTING)
        number = min(len(gap), max(least, usual))
        frames |= {gap[len(gap) * (k + 1) // (number + 1)] for k in range(number)}
    return sorted(frames)


def swept_view(
    camera: Camera,  # of all images
    reference: PosedImage,
    others: list[PosedImage],
    planes: np.ndarray,  # (D,) 1/world unit, evenly spaced from 0
    drops_lines: bool = False,  # lines along the motion: they match at more than half of the planes
) -> votes.SweptView:
    """Sweep one image; without others nothing is found. Any process can compute it."""
    step, pose = float(planes[1]), reference.T_camera_world
    if not others:
        nothing = np.full_like(reference.gray, np.nan)
        return votes.SweptView(nothing, np.ones_like(nothing), step, pose)
    cost = sweep(camera, reference, others, planes)
    best, fraction = refined_minimum(aggregate(cost, reference.gray))
    found = ((best + fraction) * step).clip(FARTHEST * step).astype(np.float32)
    found[best == len(planes) - 1] = np.nan  # the cost still falls: the minimum lies nearer
    at_best = np.take_along_axis(cost, best[None], 0)[0]
    found[(best == 0) & (at_best >= votes.CONFIRMING_COST)] = np.nan  # the cost has no minimum
    if drops_lines:
        are_alike = (cost < at_best + ALIKE).mean(0) > MOST_ALIKE
        found[are_alike & (at_best < votes.CONFIRMING_COST)] = np.nan
    return votes.SweptView(found, at_best, step, pose)


class SweepPlanner:
    """Chooses the views and planes of a sweep. It keeps the small grey images that it has read."""

    device: torch.device | str = "cpu"  # of what is found; OpenCV sweeps on the CPU

    def __init__(
        self,
        read: Callable[[int], Frame],  # a frame by its index
        camera: Camera,  # of its images
        poses: dict[int, Tensor],  # T_camera_world (4, 4) of what is swept against, by frame index
        disparities: dict[int, np.ndarray],  # (n,) 1/world unit, by frame: place the nearest plane
        width: int = WIDTH,  # px of the images that are swept, at most
    ) -> None:
        self.of_images, self.camera = camera, _small(camera, width)
        self._read, self._known, self._is_for_map = read, disparities, width == WIDTH
        self._poses = {index: pose.double().cpu().numpy() for index, pose in poses.items()}
        self._centres = {k: np.linalg.inv(pose)[:3, 3] for k, pose in self._poses.items()}
        self._image = lru_cache(maxsize=4 * REACH)(self._read_image)

    @classmethod
    def of(
        cls, graph: KeyframeGraph, sequence: Sequence, poses: dict[int, Tensor], width: int = WIDTH
    ) -> "SweepPlanner":
        """Return the planner by the disparities on which keyframes agree."""
        frames = [(k, f.frame_index) for k, f in enumerate(graph.keyframes.frames)]
        agreed = {i: agreed_disparities(graph, k).cpu().numpy() for k, i in frames if i in poses}
        inputs = graph.grid.camera, poses, agreed, width
        planner = cls(lambda index: graph.shutter.undone(sequence.frame(index)), *inputs)
        planner.device = graph.grid.rays.device
        return planner

    def plan(self, frame: int) -> tuple[Camera, PosedImage, list[PosedImage], np.ndarray, bool]:
        """Return the arguments of `swept_view`, by the structure known around a frame.

        Only sweeps for the map drop lines: what coarse ones confirm tells turns as well.
        """
        at = int(np.argmin([abs(frame - index) for index in self._known]))
        known = np.concatenate([*self._known.values()][max(0, at - 1) : at + 2])
        others = self._views(frame, float(np.median(known)))
        nearest = DEPTH_RANGE * float(np.quantile(known, LARGEST_QUANTILE))
        baseline = max(others.values(), default=0.0)
        parallax = baseline * nearest * self.camera.fx
        planes = np.linspace(0, nearest, int(np.clip(parallax, *PLANES)))  # about one per pixel
        views = [self._image(other) for other in others] if baseline > 0 else []
        drops_lines = self._is_for_map and parallax > LEAST_PARALLAX
        return self.camera, self._image(frame), views, planes, drops_lines

    def _read_image(self, frame_index: int) -> PosedImage:
        gray = cv2.cvtColor(self._read(frame_index).image.numpy(), cv2.COLOR_RGB2GRAY)
        size = (self.camera.width, self.camera.height)
        small = cv2.resize(gray, size, None, 0, 0, cv2.INTER_AREA)
        return PosedImage(small, self._poses[frame_index])

    def _views(self, frame: int, inverse_depth: float) -> dict[int, float]:
        """Choose the frames to sweep against, spread evenly over those of moderate parallax.

        If fewer than two are, the nearest in time. Each comes with its distance [world unit].
        """
        here, near = self._centres[frame], [k for k in self._poses if 0 < abs(k - frame) <= REACH]
        distances = {k: float(np.linalg.norm(here - self._centres[k])) for k in near}
        limit = MAX_PARALLAX * self.camera.width / (self.camera.fx * inverse_depth)
        chosen = [k for k in near if distances[k] <= limit]
        if len(chosen) < 2:
            chosen = sorted(near, key=lambda k: abs(k - frame))[:2]
        return {chosen[k]: distances[chosen[k]] for k in votes.evenly(len(chosen), VIEWS)}


def full_size(depth: votes.ConfirmedDepth, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return depth (H, W), 0 where unknown, and confirmation (H, W) at the size of the images.

    Inverse depth is interpolated on a surface; at its edge each pixel takes the nearest value.
    """
    size = (camera.width, camera.height)
    methods, square = (cv2.INTER_LINEAR, cv2.INTER_NEAREST_EXACT), np.ones((3, 3), np.uint8)
    smooth, nearest = (cv2.resize(depth.inverse_depth, size, None, 0, 0, m) for m in methods)
    largest, smallest = (f(depth.inverse_depth, square) for f in (cv2.dilate, cv2.erode))
    surface = (largest < EDGE_RATIO * smallest) & (depth.inverse_depth > 0)
    inside = cv2.resize(surface.astype(np.uint8), size, None, 0, 0, cv2.INTER_NEAREST_EXACT) > 0
    inverse = np.where(inside, smooth, nearest)
    full = np.where(inverse > 0, 1 / np.maximum(inverse, 1e-6), 0).astype(np.float32)
    confirmation = cv2.resize(depth.confirmation, size, None, 0, 0, cv2.INTER_LINEAR)
    return torch.from_numpy(full), torch.from_numpy(confirmation)
