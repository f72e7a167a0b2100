"""The mask M of the disparity prior, Eq. (8)."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from minislam.geometry import Camera, se3_exp
from minislam.tracking.config import TrackingConfig
from minislam.tracking.disparity_prior import (
    DepthView,
    depth_consistency,
    mask_priors,
    prior_mask,
    sample_features,
    warp_depth,
)
from minislam.tracking.grid import Grid
from minislam.tracking.optimisation import bundle_problem
from minislam.tracking.safeguards.relocalisation import attach_newest
from tests.tracking.scene import CAMERA, STRIDE, uniform
from tests.tracking.wall import true_graph

CONFIG = TrackingConfig(prior_mask=True, lambda_disparity_prior=0.01)
EPSILON, GAMMA = 0.02, 0.9  # paper
GRID = Grid.of(CAMERA, 1)  # every pixel is a cell
SHAPE = (CAMERA.height, CAMERA.width)
WALL, BOX = 2.0, 1.0  # world units in front of all cameras
WALL_LOOK, BOX_LOOK = torch.eye(2, dtype=torch.float64)  # features
STEP = 0.1  # world units sideways: the wall moves by 3 px, the box by 6 px
NOWHERE = (9.0, 9.0)


def view(offset: float, box: tuple[float, float] = NOWHERE, look: Tensor = BOX_LOOK) -> DepthView:
    """Return what a camera at x = offset sees: a wall, and a box from x = box[0] to box[1]."""
    column = CAMERA.rays(GRID.pixels.double())[:, 0].reshape(SHAPE)
    on_box = (column * BOX + offset >= box[0]) & (column * BOX + offset <= box[1])
    depth = torch.where(on_box, BOX, WALL).double()
    features = torch.where(on_box[..., None], look, WALL_LOOK)
    sideways = torch.tensor([-offset, 0, 0, 0, 0, 0], dtype=torch.float64)
    return DepthView(depth, features, se3_exp(sideways))


def scaled_depth(seen: DepthView, factor: float, columns: slice) -> DepthView:
    depth = seen.metric_depth.clone()
    depth[:, columns] *= factor
    return replace(seen, metric_depth=depth)


def columns_of(cells: Tensor) -> list[int]:
    """Return the columns in which this is true, the same in every row."""
    rows = cells.reshape(SHAPE)
    assert (rows == rows[:1]).all()
    return rows[0].nonzero().squeeze(1).tolist()


def counted(ours: DepthView, others: list[DepthView]) -> tuple[Tensor, Tensor]:
    return depth_consistency(GRID, ours, others, EPSILON, GAMMA)


# Known answers


def test_a_wrong_patch_is_masked_and_everything_else_is_kept():
    wrong = scaled_depth(view(0.0), 0.7, slice(30, 40))
    mask = prior_mask(GRID, wrong, [view(STEP), view(-STEP)], CONFIG)
    assert columns_of(~mask) == list(range(30, 40))


@pytest.mark.parametrize(
    ("factor", "masked"), [(1.0198, 0), (1.0202, 10), (0.9802, 0), (0.9798, 10)]
)
def test_the_error_is_relative_to_the_depth_that_arrives(factor: float, masked: int):
    wrong = scaled_depth(view(0.0), factor, slice(30, 40))
    mask = prior_mask(GRID, wrong, [view(STEP), view(-STEP)], CONFIG)
    assert len(columns_of(~mask)) == masked


def test_one_other_view_is_not_enough_to_mask():
    # On purpose: the official code masks on one contradiction, the paper wants more than one
    # correspondence.
    wrong = scaled_depth(view(0.0), 0.7, slice(None))
    assert prior_mask(GRID, wrong, [view(STEP)], CONFIG).all()
    # Of two neighbours, 3 px on either side see the outermost 3 columns each.
    mask = prior_mask(GRID, wrong, [view(STEP), view(-STEP)], CONFIG)
    assert columns_of(mask) == [0, 1, 2, 77, 78, 79]


def test_two_views_that_agree_outvote_one_that_does_not():
    others = [scaled_depth(view(STEP), 1.03, slice(None)), view(-STEP), view(2 * STEP)]
    corresponding, consistent = counted(view(0.0), others)
    mask = prior_mask(GRID, view(0.0), others, CONFIG)
    in_all_views = (slice(None), slice(10, 70))
    assert (corresponding.reshape(SHAPE)[in_all_views] == 3).all()
    assert (consistent.reshape(SHAPE)[in_all_views] == 2).all()
    assert mask.reshape(SHAPE)[in_all_views].all()


def test_depth_is_carried_along_the_viewing_direction():
    # We stand 0.5 in front of the other camera: its wall is 1.5 away from us.
    forward = torch.tensor([0, 0, -0.5, 0, 0, 0], dtype=torch.float64)
    looks = WALL_LOOK.expand(len(GRID.pixels), 2)
    arrived = warp_depth(GRID, looks, view(0.0), se3_exp(forward), GAMMA)
    hit = arrived > 0
    assert torch.allclose(arrived[hit], torch.tensor(1.5, dtype=torch.float64))
    # 0.75^2 of our pixels are hit: the other's are spread over a wider image.
    assert abs(float(hit.double().mean()) - 0.75**2) < 0.02


@pytest.mark.parametrize("offset", [STEP, -STEP])
def test_an_occluded_surface_is_not_counted_as_inconsistent(offset: float):
    # The neighbour sees wall that the box hides from us, and all features are equal. If the last
    # point written counted instead of the nearest, one of the two directions would fail.
    box = (0.005, 0.305)
    ours, other = (view(x, box, look=WALL_LOOK) for x in (0.0, offset))
    corresponding, consistent = counted(ours, [other])
    assert torch.equal(corresponding, consistent)
    on_box = ours.metric_depth.reshape(-1) == BOX
    assert consistent[on_box].all()
    # And it is true that something is hidden: without the box more wall arrives.
    without_box = replace(other, metric_depth=torch.where(other.metric_depth < WALL, 0, WALL))
    assert counted(ours, [without_box])[0][on_box].any()


def test_a_moving_thing_with_unlike_features_is_skipped():
    ours = view(0.0)
    others = [view(STEP, box=(0.0, 0.2)), view(-STEP, box=(0.05, 0.25))]
    corresponding, consistent = counted(ours, others)
    assert torch.equal(corresponding, consistent)
    assert prior_mask(GRID, ours, others, CONFIG).all()
    # If it looked like the wall it would be a contradiction.
    blind = replace(CONFIG, mask_min_similarity=-2.0)
    assert not prior_mask(GRID, ours, others, blind).all()


def test_features_are_sampled_where_their_cells_lie():
    # Each cell holds the pixel of its centre, so sampling must return the pixel itself.
    camera = Camera(50.0, 50.0, 20.0, 10.0, width=45, height=29)
    rows, columns = 4, 6
    u = (torch.arange(columns, dtype=torch.float64) + 0.5) * 45 / columns - 0.5
    v = (torch.arange(rows, dtype=torch.float64) + 0.5) * 29 / rows - 0.5
    features = torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)
    pixels = torch.tensor([[3.25, 3.125], [12.0, 7.0], [40.75, 24.875]], dtype=torch.float64)
    assert torch.allclose(sample_features(features, pixels, camera), pixels)
    corner = torch.tensor([[0.0, 28.0]], dtype=torch.float64)
    held = torch.tensor([[3.25, 24.875]], dtype=torch.float64)
    assert torch.allclose(sample_features(features, corner, camera), held)


# Degenerate input


def test_without_other_views_everything_is_kept():
    corresponding, consistent = counted(view(0.0), [])
    assert not corresponding.any() and not consistent.any()
    assert prior_mask(GRID, view(0.0), [], CONFIG).all()


def test_where_no_depth_is_known_nothing_is_judged():
    hole = scaled_depth(view(0.0), 0.0, slice(20, 30))
    corresponding, _ = counted(hole, [view(STEP), view(-STEP)])
    assert columns_of(corresponding == 0) == list(range(20, 30))
    blind = scaled_depth(view(STEP), 0.0, slice(None))
    assert not counted(view(0.0), [blind])[0].any()


def test_cameras_that_look_away_have_no_word():
    turned = torch.tensor([0, 0, 0, 0, torch.pi, 0], dtype=torch.float64)
    behind = replace(view(0.0), T_camera_world=se3_exp(turned))
    assert not counted(view(0.0), [behind])[0].any()
    looks = WALL_LOOK.expand(len(GRID.pixels), 2)
    assert (warp_depth(GRID, looks, view(0.0), se3_exp(turned), GAMMA) == 0).all()


# In the back-end


def graph_with_depths(config: TrackingConfig):
    """Return four keyframes in front of the wall; the depth of the last is wrong on the left."""
    graph = true_graph([0, 1, 2, 3], config)
    keyframes = graph.keyframes
    for index in range(4):
        disparities = keyframes.disparities[index].reshape(graph.grid.shape)
        fine = torch.nn.functional.interpolate(
            disparities[None, None], (49, 73), mode="bilinear", align_corners=True
        )
        depth = torch.zeros(SHAPE)
        depth[:49, :73] = 1 / fine[0, 0]
        if index == 3:
            depth[:, :40] *= 1.3
        keyframes.metric_depths[index] = depth
        keyframes.features[index] = 1.0 + uniform(index, 3, 4, 2).float() / 100
        cells = depth[::STRIDE, ::STRIDE].reshape(-1)
        keyframes.prior_disparities[index] = cells.reciprocal()
    return graph


EDGES = [(3, 0), (0, 3), (3, 1), (1, 3), (3, 2), (2, 3)]


def test_the_prior_of_a_masked_cell_has_no_weight():
    graph = graph_with_depths(CONFIG)
    graph.match(EDGES)
    mask_priors(graph, EDGES, first=3)
    mask = graph.keyframes.prior_masks
    assert mask[:3].all(), "only the keyframes from `first` on are judged"
    last = mask[3].reshape(graph.grid.shape)
    assert last[:, 5:].all() and not last[2:5, 2:5].any()
    lambda_prior = CONFIG.lambda_disparity_prior
    weights = bundle_problem(graph, range(len(EDGES)), lambda_prior=lambda_prior).prior_weights
    strength = lambda_prior * CAMERA.fx**2
    assert torch.allclose(weights, strength * mask.float())


def test_a_keyframe_that_is_found_again_gets_its_mask():
    graph = graph_with_depths(CONFIG)
    graph.flow_to_next[2] = None  # the camera was lost before the last
    assert attach_newest(graph, 1)
    last = graph.keyframes.prior_masks[3].reshape(graph.grid.shape)
    assert last[:, 5:].all() and not last[2:5, 2:5].any()


def test_the_mask_can_be_switched_off():
    off = replace(CONFIG, prior_mask=False)
    graph = graph_with_depths(off)
    mask_priors(graph, EDGES)
    assert graph.keyframes.prior_masks.all()


def test_keyframes_without_depth_are_passed_over():
    graph = graph_with_depths(CONFIG)
    graph.keyframes.metric_depths[0] = graph.keyframes.metric_depths[3] = None
    mask_priors(graph, EDGES)
    assert graph.keyframes.prior_masks.all()
