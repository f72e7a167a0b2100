"""Bundle adjustment, Eq. (5), over parts of the keyframe graph: local BA and global BA."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from minislam.records import Progress
from minislam.state.memory import release, stack
from minislam.tracking.bundle_adjustment import BundleReport, bundle_adjust, residuals
from minislam.tracking.bundle_problem import BundleProblem, BundleState
from minislam.tracking.disparity_prior import mask_priors
from minislam.tracking.frame_graph import at_once
from minislam.tracking.keyframe_graph import Edge, KeyframeGraph
from minislam.tracking.reprojection import lengths
from minislam.tracking.safeguards.parts import in_parts, joined, of_cells, of_rows
from minislam.tracking.safeguards.robust import weighted_median

FIRST_WIDENING = 8.0  # times the robust width: a new keyframe's error makes its cells outliers [-]
EVERY = 4  # one cell in so many is sampled for the typical residual
FEW_KEYFRAMES = 100  # so few are not worth a selection
FITTING_RESIDUAL = 1.5  # px at 320x240: new edges that are better fit already (diary/tracking.md)
SAMPLED = 4  # keyframes: one in so many tells whether new edges fit (diary/time_and_memory.md)
ENOUGH_EDGES = 8  # that tell it


def local_ba(graph: KeyframeGraph) -> None:
    """Link the newest keyframe, then adjust the newest `window` keyframes together.

    A new pose may be wrong, so a classical flow is first started from composed flow instead, and
    adjusted. Then further edges are added, and flow and BA alternate.
    """
    config, newest = graph.config, len(graph.keyframes) - 1
    first_free = max(0, newest + 1 - config.window)
    if not graph.is_learned:
        graph.match_composed(newest)
        adjust(graph, first_free, config.iterations, widening=FIRST_WIDENING)
    edges = graph.neighbour_edges(newest) + graph.proximity_edges(newest)
    mask_priors(graph, edges, first=newest)
    old = [edge for edge in graph.edges.ends if edge not in edges]
    edges += old[max(0, len(old) + len(edges) - config.active_edges) :]
    for _ in range(config.rounds):
        graph.match(edges)
        adjust(graph, first_free, config.iterations)


def online_global_ba(graph: KeyframeGraph) -> None:
    """Adjust all keyframes while the sequence goes on; flow is measured only on new edges.

    If those of a sample of the keyframes fit already, nothing has drifted, and it can wait.
    """
    sample, first_new = graph.global_edges(every=SAMPLED), len(graph.edges)
    if len(sample) >= ENOUGH_EDGES:
        graph.match(sample)
        if mean_residual(graph, first_new) <= FITTING_RESIDUAL * graph.pixel_scale:
            return
        graph.edges.remove_newest(len(sample))
    graph.match(graph.global_edges())
    adjust(graph, 0, graph.config.global_iterations, free_camera=True)


def final_global_ba(graph: KeyframeGraph, progress: Progress | None = None) -> None:
    """Adjust all keyframes on flow measured anew, without the prior unless `final_prior`."""
    config = graph.config
    edges = graph.edges.ends + graph.global_edges()
    lambda_prior = config.lambda_disparity_prior if config.final_prior else 0.0
    for done in range(config.final_rounds):
        graph.match(edges)
        is_last = done + 1 == config.final_rounds
        adjust(graph, 0, config.global_iterations, lambda_prior, free_camera=True, settled=is_last)
        if progress:
            progress(done + 1, config.final_rounds)


def warm_up_ba(graph: KeyframeGraph, edges: list[Edge], rounds: int) -> None:
    """Adjust the keyframes of the warm-up together: rounds of flow and BA."""
    for _ in range(rounds):
        graph.match(edges)
        adjust(graph, 0, graph.config.warmup_iterations, free_camera=True)


def mean_residual(graph: KeyframeGraph, first_edge: int) -> float:
    """Return the weighted mean length of the residuals [px], over edges `first_edge` and later."""
    problem = bundle_problem(graph, range(first_edge, len(graph.edges)))
    residual, _ = residuals(problem, graph.state)
    weight = problem.weights.mean(1)
    return float((weight * lengths(residual)).sum() / weight.sum().clamp_min(1e-6))


def adjust(
    graph: KeyframeGraph,
    first_free: int,  # keyframes from here on move
    iterations: int,
    lambda_prior: float | None = None,  # None: as configured
    widening: float = 1.0,  # of the robust weight
    free_camera: bool = False,  # refine an unknown focal length, and the readouts
    settled: bool = False,  # poses and depths are, so the robust width follows the residuals
) -> None:
    """Run a bundle adjustment over the edges that touch the free keyframes."""
    positions = [p for p, edge in enumerate(graph.edges.ends) if max(edge) >= first_free]
    if lambda_prior is None:
        lambda_prior = graph.config.lambda_disparity_prior
    problem = bundle_problem(graph, positions, first_free, lambda_prior)
    if problem.robust is not None:
        kernel = problem.robust.widened(widening)
        if settled:
            kernel = kernel.narrowed(typical_residual(problem, graph.state))
        problem = replace(problem, robust=kernel)
    if free_camera:
        columns = graph.shutter.edge_columns(positions) if graph.shutter.is_found else None
        problem = replace(problem, free_focal=graph.focal_is_free, shift_columns=columns)
    # Without parallax the flow does not measure depth. Where older keyframes are held, such a
    # keyframe keeps its disparities, which hold the scale until the camera moves again; where all
    # keyframes are adjusted, only one with a prior does.
    largest = graph.grid.rays.new_zeros(len(graph.keyframes))
    parallaxes = graph.parallaxes(problem.edges_source, problem.edges_target)
    largest.scatter_reduce_(0, problem.edges_source, parallaxes, "amax")
    worth_keeping = (graph.keyframes.prior_disparities > 0).any(1) | (first_free > 0)
    may_change = (largest >= graph.least_parallax) | ~worth_keeping
    problem = replace(problem, free_disparities=problem.free_disparities & may_change)
    state, report = adjust_touched(problem, graph.state, iterations)
    graph.keyframes.set_geometry(state.T_camera_world, state.disparities)
    graph.grid.zoom(state.log_focal)
    graph.shutter.lengthen(state.shifts)
    graph.count_adjustment(report)


def typical_residual(problem: BundleProblem, state: BundleState) -> float | None:
    """Return the weighted median length of the residuals [px]; None if all weights are 0."""
    cells = torch.arange(0, len(problem.rays), EVERY, device=problem.rays.device)
    problem, found = replace(problem, robust=None), []
    for edges, part in in_parts(problem):
        residual, weights = residuals(*of_cells(part, state, cells))
        found.append((edges, lengths(residual), weights[:, 0]))
    return weighted_median(*joined(found))


def adjust_touched(
    problem: BundleProblem, state: BundleState, iterations: int
) -> tuple[BundleState, BundleReport]:
    """Run `bundle_adjust` on the touched keyframes alone; the others stay, so they cost no time."""
    rows = touched_rows(problem)
    found, report = bundle_adjust(*of_rows(problem, state, rows), iterations)
    poses, disparities = state.T_camera_world.clone(), state.disparities.clone()
    poses[rows], disparities[rows] = found.T_camera_world, found.disparities
    return replace(found, T_camera_world=poses, disparities=disparities), report


def touched_rows(problem: BundleProblem) -> Tensor:  # (K',) keyframe index
    """Return the keyframes that a problem moves or has an edge to; all, if there are few."""
    is_touched = problem.free_disparities.clone()
    is_touched[problem.edges_source] = is_touched[problem.edges_target] = True
    return (is_touched | (len(is_touched) <= FEW_KEYFRAMES)).nonzero()[:, 0]


def adjust_narrowing(
    problem: BundleProblem,
    state: BundleState,
    widenings: list[float],  # of the robust weight, one after the other
    iterations: int,  # with each
) -> tuple[BundleState, BundleReport]:
    """Return the adjusted state and the last report. Any process can compute it."""
    for widening in widenings:
        robust = problem.robust and problem.robust.widened(widening)
        state, report = bundle_adjust(replace(problem, robust=robust), state, iterations)
    return state, report


def bundle_problem(
    graph: KeyframeGraph,
    positions: Sequence[int],  # of edges in the graph
    first_free: int = 0,  # keyframes from here on move
    lambda_prior: float = 0.0,  # lambda_4
) -> BundleProblem:
    """Collect edges of the graph into the bundle problem of Eq. (5)."""
    keyframes, edges, grid = graph.keyframes, graph.edges, graph.grid
    ends = [edges.ends[p] for p in positions]
    edges_source, edges_target = torch.tensor(ends, device=grid.rays.device).unbind(1)
    targets = stack([edges.targets[p] for p in positions])
    weights = stack([edges.confidences[p] for p in positions])

    # Eq. (5) weighs by beta of the source. A learned confidence also notices a target that a
    # dynamic object covers; a classical one does not, so the target's weight counts as well.
    cells, columns = keyframes.cell_weights, (weights, edges_source, edges_target, targets)
    for weight, source, target, position in zip(*map(at_once, columns), strict=True):
        static = cells[source]
        if not graph.is_learned:
            static = static * grid.sample(cells[target][..., None], position.mT)[..., 0]
        weight *= static[:, None]
        release()

    prior = keyframes.prior_disparities
    strength = lambda_prior * grid.camera.fx**2
    free = torch.arange(len(keyframes), device=prior.device) >= first_free
    free_poses = free.clone()
    free_poses[0] = False  # the first camera is the world
    return BundleProblem(
        camera=grid.camera, rays=grid.rays,
        edges_source=edges_source, edges_target=edges_target,
        targets=targets, weights=weights,
        prior_disparities=prior, prior_weights=strength * (prior > 0) * keyframes.prior_masks,
        free_poses=free_poses, free_disparities=free, robust=graph.robust,
        disparity_damping=graph.flow.disparity_damping(len(keyframes)),
    )  # fmt: skip
