"""A rolling shutter: an image whose rows are not exposed at the same time.

Let rho be the readout, the seconds from the first row to the last. The point x in row v is seen

    rho s(x),    s(x) = v / H - 1/2,

later than the middle row. If the image moves there at u px/s, a global shutter would have seen the
point at x - rho s u. So to first order in rho, flow from cell x of keyframe i to p~ in keyframe j
becomes that of a global shutter by

    p~ + rho c,    c = s(x) u_i(x) - s(p~) u_j(p~).

The flow between neighbouring frames gives u, without any pose. The residual of Eq. (5) is linear in
rho, which is one more unknown with the column c. Sensors are read along the shorter side of the
image, a phone held upright along x: the readout along the longer side stays 0.
"""

import math
from dataclasses import replace

import cv2
import numpy as np
import torch
from torch import Tensor

from minislam.geometry import Camera
from minislam.priors.dense_flow import dense_from_grid, grayscale, residual_flow, warp
from minislam.priors.interfaces import FlowMatches
from minislam.records import Frame
from minislam.state.memory import SHELF, stack
from minislam.state.stateful import Stateful
from minislam.tracking.frame_graph import FrameGraph, at_once
from minislam.tracking.grid import Grid
from minislam.tracking.keyframes import KeyframeStore
from minislam.tracking.reprojection import Linearisation

Readout = tuple[float, float]  # s, from left to right and from top to bottom

NEGLIGIBLE = 0.1  # px; an image that is displaced by less is left as it is


class ImageMotion(Stateful):
    """The velocity of each cell of the image in each frame seen."""

    first: int = 0  # frame that was seen first
    velocities: list[Tensor]  # per frame u (2, N) px/s, by the frame before it
    shortest_step: float = math.inf  # s between two images of the source: no readout is longer
    _newest: Frame | None = None

    def __init__(self, grid: Grid) -> None:
        self._grid, self.velocities = grid, []

    def see(self, frame: Frame) -> None:
        """Measure how the image has moved since the frame before. Frames come in their order."""
        before, self._newest = self._newest, frame
        if before is None:
            self.first = frame.frame_index
        velocity = torch.zeros_like(self._grid.pixels.T)
        if before is not None:
            seconds = frame.timestamp - before.timestamp
            back = residual_flow(grayscale(frame.image), grayscale(before.image))
            cells = back[:: self._grid.stride, :: self._grid.stride].reshape(-1, 2).T.copy()
            velocity = torch.from_numpy(cells).to(velocity) / -seconds
            self.shortest_step = min(self.shortest_step, seconds, frame.step)
        self.velocities.append(velocity)

    def velocity(self, frame_index: int) -> Tensor:  # (2, N) px/s
        """Return how fast the image of a frame moves: the mean of before and after it."""
        at = frame_index - self.first
        around = self.velocities[max(at, 1) : at + 2]  # none before the first
        return torch.stack(around).mean(0) if around else torch.zeros_like(self._grid.pixels.T)

    def displacement(self, frame_index: int, readout: Readout) -> np.ndarray | None:  # (H, W, 2)
        """Return how far the rolling shutter moves each pixel of a frame [px]; None: negligible."""
        grid, camera = self._grid, self._grid.camera
        late = grid.pixels.new_tensor(readout) @ lateness(grid.pixels.T, camera)  # s
        moved = self.velocity(frame_index) * late
        if not moved.abs().max() > NEGLIGIBLE:
            return None
        cells = (grid.pixels + moved.T).reshape(*grid.shape, 2).cpu().numpy()
        return dense_from_grid(cells, (camera.height, camera.width), grid.stride)


class RollingShutter(Stateful):
    """The readouts, found from the flow along all edges and from the motion of the image."""

    readout: Readout = (0.0, 0.0)
    is_found: bool = False  # estimated from the flow; all later adjustments refine it
    motion: ImageMotion

    def __init__(self, grid: Grid, keyframes: KeyframeStore, edges: FrameGraph, is_on: bool):
        self._grid, self._keyframes, self._edges, self.is_on = grid, keyframes, edges, is_on
        self.motion = ImageMotion(grid)

    def see(self, frame: Frame) -> None:
        """Measure how the image has moved since the frame before."""
        if self.is_on:
            self.motion.see(frame)

    def columns(
        self,
        edges: list[tuple[int, int]],  # keyframe indices
        targets: Tensor,  # (E, 2, N) px, p~ of the source's cells
        next_frame: int | None = None,  # frame that counts as the keyframe after the newest
    ) -> Tensor:  # (E, 2, 2, N) px/s
        """Return c, the derivative of the flow of some edges by either readout."""
        frames = [frame.frame_index for frame in self._keyframes.frames]
        frames += [] if next_frame is None else [next_frame]
        ends = {end for edge in edges for end in edge}
        u = {end: self.motion.velocity(frames[end]) for end in ends}
        u_source = torch.stack([u[source] for source, _ in edges])
        u_target = torch.stack([u[target].mT for _, target in edges])
        u_target = self._grid.sample(u_target, targets.mT).mT
        pixels, camera = self._grid.pixels.T, self._grid.camera
        late_source, late_target = lateness(pixels, camera), lateness(targets, camera)
        at_source = late_source[:, None] * u_source[:, None]
        return at_source - late_target[:, :, None] * u_target[:, None]

    def corrected(
        self, matches: FlowMatches, edges: list[tuple[int, int]], next_frame: int | None = None
    ) -> FlowMatches:
        """Return the matches of some edges as a global shutter would have seen them."""
        if not any(self.readout):
            return matches
        columns = self.columns(edges, matches.targets, next_frame)
        return replace(matches, targets=matches.targets + displacements(columns, self.readout))

    def edge_columns(self, positions: list[int]) -> Tensor | None:  # (E, 2, 2, N) px/s
        """Return c of the edges at these positions in the graph, None if nothing is estimated.

        That of the readout along the longer side is 0, so no adjustment moves it.
        """
        if not (self.is_on and positions):
            return None
        rows: list[Tensor] = []
        for part in at_once(positions):
            targets = torch.stack([self._edges.targets[position] for position in part])
            columns = self.columns([self._edges.ends[position] for position in part], targets)
            columns[:, int(self._grid.camera.width < self._grid.camera.height)] = 0
            rows += SHELF.rows(columns)
        return stack(rows)

    def is_possible(self, readout: Readout) -> bool:
        """Tell whether a readout is shorter than a frame's time; else it fits something else."""
        return max(map(abs, readout)) < self.motion.shortest_step

    def take(self, found: Readout) -> None:
        """Set the readouts estimated from the flow; all later adjustments refine them."""
        self.is_found = True
        self.lengthen(found)

    def lengthen(self, seconds: Readout) -> None:
        """Make the readouts longer, at most a frame's time, and correct the flow of all edges."""
        if not any(seconds):
            return
        before, longest = self.readout, self.motion.shortest_step
        after = [min(max(-longest, a + b), longest) for a, b in zip(before, seconds, strict=True)]
        self.readout = after[0], after[1]
        moved: list[Tensor] = []
        for ends, rows in zip(at_once(self._edges.ends), at_once(self._edges.targets), strict=True):
            columns = self.columns(ends, targets := torch.stack(rows))
            change = displacements(columns, self.readout) - displacements(columns, before)
            moved += SHELF.rows(targets + change)
        self._edges.targets = moved

    def undone(self, frame: Frame) -> Frame:
        """Return a frame as a global shutter would have seen it."""
        moved = self.motion.displacement(frame.frame_index, self.readout)
        if moved is None:
            return frame
        pixels = warp(frame.pixels.cpu().numpy(), moved, cv2.INTER_CUBIC)
        return replace(frame, pixels=torch.from_numpy(pixels).to(frame.pixels))


def lateness(pixels: Tensor, camera: Camera) -> Tensor:  # both (..., 2, N)
    """Return s(x) of pixels x in u and in v: how long after the middle each is read, over rho."""
    return pixels / pixels.new_tensor([[camera.width], [camera.height]]) - 0.5


def displacements(columns: Tensor, readout: Readout) -> Tensor:  # (E, 2, N) px
    """Return rho_x c_x + rho_y c_y: how far flow moves with columns (E, 2, 2, N) and readouts."""
    return readout[0] * columns[:, 0] + readout[1] * columns[:, 1]


def with_shifts(found: Linearisation, columns: Tensor | None, shifts: Readout) -> Linearisation:
    """Return a reprojection as a rolling shutter, or a lens, sees it; J_target gains -columns."""
    if columns is None:  # they are held
        return found
    seen = found.positions - displacements(columns, shifts)
    return replace(found, positions=seen, J_target=torch.cat([found.J_target, -columns], 1))
