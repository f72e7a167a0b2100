"""The second adjustment: bundle adjustment again, on what several views confirm to stand still.

A dynamic object that fills much of the view, or moves along the epipolar lines, has small residuals
and bends the poses. But it is swept to depths on which no two views agree. So confirmation
multiplies the static weight of each cell, and swept depth is the start, of one more final BA.
"""

from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from minislam.records import Progress, Sequence
from minislam.stereo.dense_structure import SweepPlanner, dense_depths, swept_frames
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.optimisation import final_global_ba
from minislam.tracking.tracker import Tracker
from minislam.tracking.trajectory import pose_frames
from minislam.workers import Workers

UNCONFIRMED_WEIGHT = 0.02  # of a cell: where no cell is confirmed, all count alike [-]
COARSE_WIDTH = 80  # px of the images that are swept: a weight per grid cell needs no more


def adjust_again(
    tracker: Tracker,
    sequence: Sequence,
    on_progress: Callable[[str], Progress | None] = lambda stage: None,
    workers: Workers | None = None,  # sweep side by side
) -> None:
    """Adjust the keyframes on what sweeps confirm, and judge them.

    Frames between keyframes are posed and swept as well, to vote. None is called lost here.
    """
    keyframes = [frame.frame_index for frame in tracker.keyframes.frames]
    followed = [frame.frame_index for frame in tracker.tracked if frame.status.is_followed]
    wanted = {*swept_frames(keyframes, followed)}
    chosen = [frame for frame in tracker.tracked if frame.frame_index in wanted]
    poses, _ = pose_frames(tracker.graph, chosen, sequence, on_progress("posing frames"))
    on_sweep, on_round = on_progress("coarse depth"), on_progress("second adjustment")
    planner = SweepPlanner.of(tracker.graph, sequence, poses, COARSE_WIDTH)
    swept = dense_depths(planner, sorted(poses), keyframes, on_sweep, workers)
    tracker.watch.confirmed = adjust_confirmed(tracker.graph, swept, on_round)
    tracker.conclude()


def adjust_confirmed(
    graph: KeyframeGraph,
    swept: Iterable[tuple[Tensor, Tensor]],  # K x depth (H, W) and confirmation (H, W)
    progress: Progress | None = None,
) -> float:
    """Adjust all keyframes on flow measured anew, each cell weighted by its confirmation.

    Return the fraction of the cells whose swept depth is known.
    """
    keyframes, stride = graph.keyframes, graph.grid.stride
    cells = [torch.stack(images)[:, ::stride, ::stride].flatten(1) for images in swept]
    depth, confirmation = torch.stack(cells, 1)
    keyframes.static_weights *= confirmation.clamp_min(UNCONFIRMED_WEIGHT)
    disparities = torch.where(depth > 0, 1 / depth.clamp_min(1e-6), keyframes.disparities)
    keyframes.set_geometry(keyframes.T_camera_world, disparities)
    final_global_ba(graph, progress)
    return float((depth > 0).float().mean())
