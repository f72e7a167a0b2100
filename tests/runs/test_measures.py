"""What a run measures of itself: how well the map shows what stands still."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from minislam.config import with_settings
from minislam.mapping.mapper import surface_depth
from minislam.records import MapImage, Pictured, Trajectory
from minislam.runs import measures
from minislam.splatting import Rendering
from tests.helpers import random_transforms
from tests.runs.finished import CAMERA, finished


def test_what_beta_leaves_out_and_what_is_guessed_is_measured(monkeypatch: pytest.MonkeyPatch):
    run = finished(left_out=0.4, unknown=0.7, shown=[1.0, 1.0])
    run.keyframe_trajectory, run.render = run.trajectory, None
    run.tracker.grid, errors = run.tracker.graph.grid, {"ate_all_cm": 1.0}
    for name, known in (("measure_run", errors), ("unseen_psnr", None), ("_ties", {})):
        monkeypatch.setattr(measures, name, lambda *_, known=known: known)
    measured = measures.measure(run, 1.0, None)
    assert (measured["left_out"], measured["guessed_depth"]) == pytest.approx((0.4, 0.5))
    run.config = with_settings(run.config, {"uncertainty.enabled": False})
    assert measures.measure(run, 1.0, None)["left_out"] is None
    run.mapper.images[0].filled = torch.arange(10) < 7  # such depth is no measurement
    run.mapper.images[0].depth = torch.ones(10)
    assert measures.measure(run, 1.0, None)["guessed_depth"] == pytest.approx(0.5)


def test_what_beta_leaves_out_is_unknown_before_the_end():
    assert measures.left_out(finished(shown=[])) is None


def test_the_visible_surface_has_the_mean_depth_and_a_gap_has_none():
    # Rendered depth is a sum over blending weights: 1.8 at an opacity of 0.9 is a surface at 2.
    depth, opacity = torch.tensor([[1.8, 0.4]]), torch.tensor([[0.9, 0.2]])
    rendering = Rendering(torch.zeros(1, 2, 3), depth, opacity, torch.ones(1))
    torch.testing.assert_close(surface_depth(rendering), torch.tensor([[2.0, 0.0]]))


def test_a_mapped_view_is_compared_as_exposed_and_where_it_stands_still():
    color, opacity = torch.full((4, 6, 3), 0.4), torch.full((4, 6), 0.9)
    opacity[0, 0] = 0.1  # a gap
    rendering = Rendering(color, 2 * opacity, opacity, torch.ones(1))
    static = torch.zeros(4, 6)
    static[:, :3] = 1
    image = torch.where(static[..., None] > 0, 0.9, 0.0).expand(4, 6, 3)  # .8 if exposed, .1 off
    keyframes = [
        SimpleNamespace(frame_index=8, T_camera_world=0, beta=static),
        SimpleNamespace(frame_index=16, T_camera_world=1, beta=0 * static),
    ]
    for keyframe, exposure in zip(keyframes, (torch.full((3,), 2.0), None), strict=True):
        picture = Pictured()
        picture.pixels, picture.exposure = image, exposure
        keyframe.image, keyframe.exposed = picture.image, picture.exposed
    mapper = SimpleNamespace(
        images=keyframes,
        camera=CAMERA,
        renderings=lambda views: (
            rendering._replace(color=color + 0.1 * view.T_camera_world) for view in views
        ),
        beta_of=lambda keyframe: keyframe.beta,
        static_weight=lambda beta, camera: beta,
    )
    uncertainty = SimpleNamespace(is_learned=True)
    run = SimpleNamespace(mapper=mapper, config=SimpleNamespace(uncertainty=uncertainty))
    run.beta_image = lambda index: 0.5 + index
    first, second = measures.mapped_views(run)
    assert (first.frame_index, second.frame_index) == (8, 16)
    assert first.static_psnr == pytest.approx(20, abs=1e-3) and second.static_psnr is None
    assert first.color.max() == pytest.approx(0.4) and second.color.max() == pytest.approx(0.5)
    assert first.depth[0, 0] == 0 and first.depth[1, 1] == pytest.approx(2)
    assert (first.beta, second.beta) == (0.5, 1.5)
    uncertainty.is_learned = False
    assert all(view.beta is None for view in measures.mapped_views(run))


def test_the_map_is_compared_with_some_frames_that_it_was_not_fitted_to():
    asked: list[int] = []

    def map_images(first: int, others: list[int]) -> list[MapImage]:
        assert first == 3  # none of the tracker
        asked[:] = others
        image, none = torch.full((4, 6, 3), 0.5), torch.zeros(4, 6)
        return [MapImage(index, image, none, none, torch.tensor(index)) for index in others]

    def render(pose: torch.Tensor) -> Rendering:
        opacity = torch.ones(4, 6)
        return Rendering(torch.full((4, 6, 3), 0.2), opacity, opacity, torch.ones(1))

    mapper = SimpleNamespace(
        images=[SimpleNamespace(frame_index=0)],
        exposures={0: torch.full((3,), 2.0)},  # so .4 is seen
        camera=CAMERA,
        render=render,
        beta_of=lambda keyframe: (torch.arange(6) < keyframe.frame_index).expand(4, 6),
        static_weight=lambda beta, camera: beta,
    )
    watch = SimpleNamespace(longest_piece=lambda poses: poses)
    tracker = SimpleNamespace(keyframes=[None] * 3, watch=watch)
    run = SimpleNamespace(mapper=mapper, tracker=tracker, map_images=map_images)
    run.poses = dict.fromkeys(range(101))
    assert measures.unseen_psnr(run) == pytest.approx(20, abs=1e-3)
    assert len(asked) == measures.MOST_UNSEEN and asked[0] == 1 and asked[-1] == 96
    run.poses = dict.fromkeys(range(9))
    assert measures.unseen_psnr(run) is not None and asked == [1, 2, 3, 4, 5, 6, 7, 8]
    tracker.watch.longest_piece = lambda poses: range(3, 6)  # of a broken run
    assert measures.unseen_psnr(run) is not None and asked == [3, 4, 5]
    tracker.watch.longest_piece = lambda poses: [0]
    assert measures.unseen_psnr(run) is None


def test_each_piece_of_a_broken_run_is_aligned_by_itself():
    truth = Trajectory(np.arange(20) / 30, random_transforms(20, "normal", 1).numpy())
    poses = truth.T_world_camera.copy()
    poses[10:, 0, 3] += 5  # the second piece is elsewhere
    run = finished(breaks=[None], segments=[(0, 9), (10, 19)], truth=[0.0])
    run.sequence.ground_truth.trajectory = truth
    run.trajectory = lambda: Trajectory(truth.timestamps, poses)
    found = measures._segment_errors(run)
    assert found == pytest.approx({"ate_0_to_9_cm": 0, "ate_10_to_19_cm": 0}, abs=1e-6)
    poses[[0, 19], 1, 3] += 1  # the first and the last frame count, too
    assert min(measures._segment_errors(run).values()) > 1
    run.tracker.watch.breaks = []
    assert measures._segment_errors(run) == {}
