"""Classical optical flow (OpenCV's DIS) behind the FlowEstimator interface.

Dense inverse search finds small displacements well and large ones badly. So the target image is
first warped by the displacement that geometry predicts, DIS finds what is left, and the two are
composed ("warp-compose"). Confidence is forward-backward agreement times texture.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
import torch
from torch import Tensor

from minislam.parameters import parameter
from minislam.priors.interfaces import FlowMatches
from minislam.stateful import Stateful

LIKENESS_WINDOW = (9, 9)  # px
LK_WINDOW = (9, 9)  # px
MAX_REMAINDER = 1.0  # px: what DIS leaves over is less, or the window sees something else
LEAST_VARIANCE = 1e-5  # of brightness in [0, 1]: below it there is nothing to correlate


@dataclass(frozen=True)
class ClassicalFlowConfig:
    """Constants of the classical flow."""

    stride: int = parameter(8, "distance between grid cells [px], as DROID-SLAM")
    consistency_scale: float = parameter(
        0.6, "forward-backward error at which confidence falls to exp(-1/2) [px]"
    )
    texture_scale: float = parameter(
        2e-4, "smaller eigenvalue of the structure tensor that halves confidence [1/px^2]"
    )
    workers: int = parameter(2, "threads that compute flows side by side; no effect on the result")


class ClassicalFlow(Stateful):
    """DIS flow between registered keyframes, started from a predicted reprojection."""

    def __init__(self, config: ClassicalFlowConfig = ClassicalFlowConfig()) -> None:
        # DIS splits the image in one stripe per OpenCV thread and does not propagate matches
        # across them: with more than one, the result would depend on the machine.
        cv2.setNumThreads(1)
        self.config = config
        self.stride = config.stride
        self._images: dict[int, np.ndarray] = {}
        self._textures: dict[int, np.ndarray] = {}

    def add_frame(self, keyframe_index: int, image: Tensor) -> None:
        """Register the image (H, W, 3) of a keyframe under its index."""
        gray = grayscale(image)
        self._images[keyframe_index] = gray
        self._textures[keyframe_index] = texture_confidence(gray, self.config)

    def remove_frame(self, keyframe_index: int) -> None:
        """Forget a keyframe."""
        del self._images[keyframe_index], self._textures[keyframe_index]

    def match(
        self,
        edges_source: list[int],  # (E,) keyframe index
        edges_target: list[int],  # (E,) keyframe index
        predicted_targets: Tensor,  # (E, h, w, 2) px
    ) -> FlowMatches:
        """Match every grid cell of each source in its target; see FlowEstimator.match."""
        edges = list(zip(edges_source, edges_target, strict=True))
        predictions = predicted_targets.numpy().astype(np.float32)
        with ThreadPoolExecutor(self.config.workers) as pool:
            flows = list(pool.map(self._edge_flow, edges, predictions))
        flow_of = dict(zip(edges, flows, strict=True))

        def measure(edge: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
            source, target = edge
            forward, backward = flow_of[edge], flow_of.get((target, source))
            if backward is None:
                backward = reverse_flow(self._images[source], self._images[target], forward)
            images, texture = (self._images[source], self._images[target]), self._textures[source]
            return measured_on_grid(*images, forward, backward, texture, self.config)

        with ThreadPoolExecutor(self.config.workers) as pool:
            measured = list(pool.map(measure, edges))
        dtype = predicted_targets.dtype
        textures = [self._textures[source] for source in edges_source]
        return as_matches([m[0] for m in measured], [m[1] for m in measured], textures, dtype)

    def _edge_flow(self, edge: tuple[int, int], predicted: np.ndarray) -> np.ndarray:
        source, target = self._images[edge[0]], self._images[edge[1]]
        return composed_flow(source, target, dense_from_grid(predicted, source.shape, self.stride))

    def start_chain(self, image: Tensor) -> "FlowChain":
        """Return a chain of flows from this image (H, W, 3) to the frames that follow it."""
        gray = grayscale(image)
        standing = np.zeros((*gray.shape, 2), np.float32)
        return FlowChain(gray, gray, standing, standing, self.config)


class FlowChain(Stateful):
    """The flow from one reference frame to the newest frame, carried from frame to frame.

    The previous frame's flow predicts the next one, so a displacement of any length is followed
    as long as each step of it is short. It needs no pose: it starts the pose. A chain is never
    changed: the next frame gives a new one, and a bad frame can be passed over.
    """

    STATE: ClassVar = dict.fromkeys(("_reference", "_newest", "_flow", "_increment"), np.ndarray)

    def __init__(
        self,
        reference: np.ndarray,  # (H, W) uint8
        newest: np.ndarray,  # (H, W) uint8
        flow: np.ndarray,  # (H, W, 2) px, reference to newest
        increment: np.ndarray,  # (H, W, 2) px, how much of it the last frame added
        config: ClassicalFlowConfig,
    ) -> None:
        self._reference, self._newest = reference, newest
        self._flow, self._increment = flow, increment
        self._config = config

    def advanced(self, image: Tensor) -> tuple["FlowChain", FlowMatches]:
        """Return the chain and the matches (E = 1) from the reference to this next image."""
        gray = grayscale(image)
        # A steady hand continues its motion, a shaking one does not: try both. Only the finished
        # flow tells which start was right; a wrong one would be continued from frame to frame.
        texture = texture_confidence(self._reference, self._config)
        measured = []
        for start in (self._flow, self._flow + self._increment):
            flow = composed_flow(self._reference, gray, start)
            backward = reverse_flow(self._reference, gray, flow)
            targets, confidence = measured_on_grid(
                self._reference, gray, flow, backward, texture, self._config
            )
            measured.append((flow, targets, confidence))
        flow, targets, confidence = max(measured, key=lambda m: m[2].sum())
        chain = FlowChain(self._reference, gray, flow, flow - self._flow, self._config)
        return chain, as_matches([targets], [confidence], [texture], torch.float32)

    def restarted(self) -> "FlowChain":
        """Return a chain that starts at the newest frame and expects the same motion to go on."""
        standing = np.zeros_like(self._flow)
        return FlowChain(self._newest, self._newest, standing, self._increment, self._config)


def grayscale(image: Tensor) -> np.ndarray:
    """Return the 8-bit luminance (H, W) of an image (H, W, 3) in [0, 1]."""
    rgb = (image.numpy() * 255 + 0.5).astype(np.uint8)
    return cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)


def texture_confidence(gray: np.ndarray, config: ClassicalFlowConfig) -> np.ndarray:
    """Return how well each grid cell can be located (h, w), in [0, 1).

    On a bare wall forward and backward flow agree on anything, so agreement alone is no
    confidence. The smaller eigenvalue of the structure tensor says whether a displacement in
    any direction would be noticed.
    """
    scaled = gray.astype(np.float32) / 255
    gx = cv2.Scharr(scaled, cv2.CV_32F, 1, 0) / 32  # 32: sum of the kernel's positive weights x 2
    gy = cv2.Scharr(scaled, cv2.CV_32F, 0, 1) / 32
    window = (7, 7)
    xx, yy, xy = (cv2.boxFilter(p, -1, window) for p in (gx * gx, gy * gy, gx * gy))
    smaller = 0.5 * (xx + yy) - np.sqrt((0.5 * (xx - yy)) ** 2 + xy**2)
    smaller = np.maximum(smaller[:: config.stride, :: config.stride], 0)
    return smaller / (smaller + config.texture_scale)


def likeness(source: np.ndarray, warped: np.ndarray, stride: int) -> np.ndarray:
    """Return how alike a source and its warped target look around each cell (h, w), in [0, 1].

    It is the squared normalised cross-correlation, blind to exposure. Forward and backward flow
    agree with each other on a black target and, here and there, on any other: this asks the images.
    """
    (mean, variance), (warped_mean, warped_variance) = map(local_statistics, (source, warped))
    product = source.astype(np.float32) * warped.astype(np.float32) / 255**2
    covariance = cv2.boxFilter(product, -1, LIKENESS_WINDOW) - mean * warped_mean
    floor = LEAST_VARIANCE**2
    correlation = covariance / np.sqrt(np.maximum(variance * warped_variance, floor))
    return np.clip(correlation, 0, 1)[::stride, ::stride] ** 2


def local_statistics(gray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and variance (H, W) of brightness in [0, 1] around each pixel."""
    scaled = gray.astype(np.float32) / 255
    mean, square = (cv2.boxFilter(image, -1, LIKENESS_WINDOW) for image in (scaled, scaled**2))
    return mean, square - mean**2


def dense_from_grid(grid_targets: np.ndarray, shape: tuple[int, int], stride: int) -> np.ndarray:
    """Return the dense flow (H, W, 2) that interpolates grid target positions (h, w, 2) [px]."""
    cells = np.mgrid[: grid_targets.shape[0], : grid_targets.shape[1]].astype(np.float32)
    grid_flow = grid_targets - stride * np.stack([cells[1], cells[0]], -1)
    column, row = np.meshgrid(
        np.arange(shape[1], dtype=np.float32) / stride,
        np.arange(shape[0], dtype=np.float32) / stride,
    )
    return sample(grid_flow, column, row)


def pixel_maps(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the column and row of every pixel, each (H, W) float32."""
    return np.meshgrid(np.arange(shape[1], dtype=np.float32), np.arange(shape[0], dtype=np.float32))


def sample(image: np.ndarray, column: np.ndarray, row: np.ndarray, method=cv2.INTER_LINEAR):
    """Return the image at these positions; those outside take the nearest border pixel."""
    return cv2.remap(image, column, row, method, borderMode=cv2.BORDER_REPLICATE)


def warp(image: np.ndarray, flow: np.ndarray, method: int = cv2.INTER_LINEAR) -> np.ndarray:
    """Return image(p + flow(p))."""
    column, row = pixel_maps(flow.shape[:2])
    return sample(image, column + flow[..., 0], row + flow[..., 1], method)


def residual_flow(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the DIS flow (H, W, 2) with source(p) = target(p + flow(p)), found from zero."""
    # One object per call: DIS keeps its buffers inside, so objects cannot be shared by threads.
    dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    return dis.calc(source, target, None)


def composed_flow(source: np.ndarray, target: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return the flow from source to target (H, W, 2), started from `start` by warp-compose.

    With W(p) = target(p + start(p)) and source(p) = W(p + r(p)), the target position of p is
    p + r(p) + start(p + r(p)).
    """
    remainder = residual_flow(source, warp(target, start))
    return remainder + warp(start, remainder)


def reverse_flow(source: np.ndarray, target: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Return the flow from target to source (H, W, 2), started at the inverse of `forward`.

    The inverse is a fixed point: b(q) = -forward(q + b(q)); three rounds bring a smooth field
    well inside what DIS corrects by itself.
    """
    inverse = -forward
    for _ in range(3):
        inverse = -warp(forward, inverse)
    return composed_flow(target, source, inverse)


def measured_on_grid(
    source: np.ndarray,  # (H, W) uint8
    target: np.ndarray,  # (H, W) uint8
    forward: np.ndarray,  # (H, W, 2) px, flow source to target
    backward: np.ndarray,  # (H, W, 2) px, flow target to source
    texture: np.ndarray,  # (h, w) in [0, 1)
    config: ClassicalFlowConfig,
) -> tuple[np.ndarray, np.ndarray]:  # (h, w, 2) px, (h, w) in [0, 1)
    """Return where each grid cell is in the target, as exactly as the images say, and how sure."""
    stride, warped = config.stride, warp(target, forward, cv2.INTER_CUBIC)
    remainder = lucas_kanade(source, same_exposure(source, warped, stride), stride)
    alike = likeness(source, warped, stride)
    return grid_matches(forward, remainder, backward, alike * texture, config)


def same_exposure(source: np.ndarray, warped: np.ndarray, stride: int) -> np.ndarray:
    """Return the warped image (H, W) uint8 with the brightness and contrast of the source.

    Both are medians over small windows, so that what moves or is covered has no say.
    """
    (mean, variance), (warped_mean, warped_variance) = (
        [of_pixels[::stride, ::stride] for of_pixels in local_statistics(image)]
        for image in (source, warped)
    )
    textured = np.minimum(variance, warped_variance) > LEAST_VARIANCE
    if not textured.any():
        return warped
    contrast = np.sqrt(np.median(variance[textured] / warped_variance[textured]))
    brightness = np.median((mean - contrast * warped_mean)[textured])
    return cv2.addWeighted(warped, contrast, warped, 0, 255 * brightness)


def lucas_kanade(source: np.ndarray, warped: np.ndarray, stride: int) -> np.ndarray:
    """Return the displacement (h, w, 2) [px] of each grid cell that the warp has left over.

    The flow of DIS is a blend of patches that overlap, off by some hundredths of a pixel in the
    same direction over large parts of an image, which turns the camera. A least-squares match of
    one window per cell has errors of its own, which average out.
    """
    cells = np.mgrid[: source.shape[0] : stride, : source.shape[1] : stride][::-1]
    points = cells.reshape(2, -1).T[:, None].astype(np.float32)
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        source, warped, points, points.copy(), winSize=LK_WINDOW, maxLevel=0,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.003),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    remainder = (moved - points).reshape(*cells.shape[1:], 2)
    usable = (found.reshape(cells.shape[1:]) == 1) & (np.abs(remainder).max(-1) < MAX_REMAINDER)
    return remainder * usable[..., None]


def grid_matches(
    forward: np.ndarray,  # (H, W, 2) px, flow source to target
    remainder: np.ndarray,  # (h, w, 2) px, what it has left over at the grid cells
    backward: np.ndarray,  # (H, W, 2) px, flow target to source
    texture: np.ndarray,  # (h, w) in [0, 1)
    config: ClassicalFlowConfig,
) -> tuple[np.ndarray, np.ndarray]:  # (h, w, 2) px, (h, w) in [0, 1)
    """Sample a flow on the grid and judge it: forward-backward agreement, texture, on the image."""
    height, width = forward.shape[:2]
    stride = config.stride
    column, row = (m[::stride, ::stride] for m in pixel_maps((height, width)))
    moved_u, moved_v = column + remainder[..., 0], row + remainder[..., 1]
    flow = sample(forward, moved_u, moved_v)
    target_u, target_v = moved_u + flow[..., 0], moved_v + flow[..., 1]
    returned = sample(backward, target_u, target_v)
    squared_error = ((remainder + flow + returned) ** 2).sum(-1)
    agreement = np.exp(-0.5 * squared_error / config.consistency_scale**2)
    inside = (target_u >= 0) & (target_u <= width - 1) & (target_v >= 0) & (target_v <= height - 1)
    return np.stack([target_u, target_v], -1), agreement * texture * inside


def as_matches(
    targets: list[np.ndarray],  # per edge (h, w, 2) px
    confidences: list[np.ndarray],  # per edge (h, w)
    textures: list[np.ndarray],  # per edge (h, w), the most its confidence could be
    dtype: torch.dtype,
) -> FlowMatches:
    """Bundle the measurements of single edges."""
    matched = torch.from_numpy(np.stack(targets)).to(dtype)
    confidence = torch.from_numpy(np.stack(confidences)).to(dtype)
    possible = torch.from_numpy(np.stack(textures)).to(dtype).sum((1, 2))
    shares = confidence.sum((1, 2)) / possible.clamp_min(1e-6)
    return FlowMatches(matched, confidence[..., None].expand(matched.shape), shares)
