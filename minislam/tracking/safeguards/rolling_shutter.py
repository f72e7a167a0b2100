"""A rolling shutter: the rows of an image are exposed one after the other.

Not in the paper, whose cameras have a global shutter; most phones and webcams have a rolling one.
With a readout of rho seconds from the first row to the last, a point seen in row v is seen

    rho s(v),    s(v) = v / H - 1/2,

later than the middle of the frame. If the image moves there with u px/s, the point was at
x - rho s u in the middle row's moment. So flow from x to p~ becomes that of a global shutter by

    p~  +  rho c,    c = s(x) u_i(x) - s(p~) u_j(p~),

to first order in rho. u is the flow to the frame before, so no pose is needed; rho is one more
unknown of Eq. (5), whose residual is linear in it.
"""

from dataclasses import replace

import torch
from torch import Tensor

from minislam.priors.dense_flow import grayscale, residual_flow
from minislam.priors.interfaces import FlowMatches
from minislam.records import Frame
from minislam.state.stateful import Stateful
from minislam.tracking.grid import Grid
from minislam.tracking.reprojection import Linearisation


class RollingShutter(Stateful):
    """The readout time, and how fast the image of each frame moves."""

    readout: Tensor  # (2,) s, from the left edge to the right and from the top to the bottom
    is_free: bool = True  # adjustments of all keyframes refine it
    velocities: list[Tensor]  # per frame (2, N) px/s, since the frame before
    first: int = 0  # index of the first of these frames
    _newest: Frame | None = None

    def __init__(self, grid: Grid) -> None:
        self._grid = grid
        self.velocities = []
        self.readout = grid.pixels.new_zeros(2)

    def see(self, frame: Frame) -> None:
        """Measure how the image has moved since the frame before."""
        velocity = torch.zeros_like(self._grid.pixels.T)
        if self._newest is None:
            self.first = frame.frame_index
        elif (seconds := frame.timestamp - self._newest.timestamp) > 0:
            flow = residual_flow(grayscale(frame.image), grayscale(self._newest.image))
            stride = self._grid.stride
            cells = torch.from_numpy(flow[::stride, ::stride].copy()).reshape(-1, 2).T
            velocity = -cells.to(velocity) / seconds
        self.velocities.append(velocity)
        self._newest = frame

    def velocity(self, frame_index: int) -> Tensor:  # (2, N) px/s
        """Return how fast the image of a frame moves: mean of before and after it."""
        known = self.velocities
        around = known[max(1, frame_index - self.first) :][:2]
        return torch.stack(around or [torch.zeros_like(self._grid.pixels.T)]).mean(0)

    def columns(self, sources: list[int], targets: list[int], positions: Tensor) -> Tensor:
        """Return c (E, 2, 2, N) [px/s] of edges between frames, given by their frame indices.

        Positions (E, 2, N) [px] are those of the source's cells in the target.
        """
        pixels, camera = self._grid.pixels, self._grid.camera
        size = pixels.new_tensor([[camera.width], [camera.height]])
        u = {frame: self.velocity(frame) for frame in {*sources, *targets}}
        at_source = torch.stack([u[frame] for frame in sources])
        at_target = torch.stack([u[frame].mT for frame in targets])
        at_target = self._grid.sample(at_target, positions.mT).mT
        late_source, late_target = pixels.T / size - 0.5, positions / size - 0.5
        return late_source[:, None] * at_source[:, None] - late_target[:, :, None] * at_target[:, None]

    def corrected(
        self, matches: FlowMatches, sources: list[int], targets: list[int]
    ) -> FlowMatches:
        """Return the matches between frames as a global shutter would have seen them."""
        if not self.readout.any():
            return matches
        columns = self.columns(sources, targets, matches.targets)
        return replace(matches, targets=matches.targets + shift(columns, self.readout))


def shift(columns: Tensor, readout: Tensor) -> Tensor:
    return torch.einsum("eakn,a->ekn", columns, readout.to(columns))


def with_readout(
    found: Linearisation, columns: Tensor | None, readout: Tensor | None
) -> Linearisation:
    """Return a reprojection as a rolling shutter sees it, with the derivative by the readout.

    Columns c (E, 2, N) [px/s]; None: the readout is held. Eq. (5).
    """
    if columns is None:
        return found
    J_target = torch.cat([found.J_target, -columns], 1)
    moved = found.positions if readout is None else found.positions - shift(columns, readout)
    return replace(found, positions=moved, J_target=J_target)
