"""What a run tells about itself: warnings, and the memory it took."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from minislam.geometry import Camera
from minislam.records import Keyframe, Pictured, Trajectory
from minislam.runs import facts
from minislam.splatting import Rendering
from minislam.tracking.keyframes import KeyframeStore
from minislam.tracking.safeguards.diagnostics import Break
from minislam.tracking.safeguards.focal_length import FocalLengthFit
from minislam.tracking.safeguards.lens import LensFit
from tests.helpers import random_transforms


def slam(**parts: object) -> SimpleNamespace:
    """Return a finished run of four frames without anything to warn of, but for these parts."""
    failed = parts.pop("failed", 0)
    graph = SimpleNamespace(
        adjustments=2 + failed,
        failed_adjustments=failed,
        least_parallax=1.0,
        seeks_focal=parts.pop("seeks_focal", False),
        focal_is_free=parts.pop("focal_is_free", False),
        grid=SimpleNamespace(camera=replace(CAMERA, fx=250.0)),
        shutter=SimpleNamespace(readout=(0.0, 0.0)),
    )
    lost, ends_lost = parts.pop("lost", 0), parts.pop("ends_lost", False)
    follows = [k < 4 - lost if ends_lost else k > lost for k in range(4)]
    frames = [
        SimpleNamespace(frame_index=k, timestamp=k / 30, status=SimpleNamespace(is_followed=there))
        for k, there in enumerate(follows)
    ]
    tracker = SimpleNamespace(
        initialised=True,
        tracked=frames,
        graph=graph,
        knows_depth=parts.pop("knows_depth", True),
        watch=SimpleNamespace(
            diagnostics=[SimpleNamespace(parallax=p) for p in parts.pop("parallax", [5.0])],
            beyond_turns=parts.pop("beyond_turns", 3.0),
            breaks=parts.pop("breaks", []),
            segments=[(0, 1), (3, 3)],
        ),
        keyframes=SimpleNamespace(
            has_prior=parts.pop("has_prior", True), overlay=parts.pop("overlay", None)
        ),
    )
    truth = parts.pop("truth", None)  # s, of the true poses
    if truth is not None:
        poses = random_transforms(len(truth), "normal", 0).numpy()
        poses = np.tile(poses[:1], (len(truth), 1, 1)) if parts.pop("stands", False) else poses
        truth = SimpleNamespace(trajectory=Trajectory(np.array(truth), poses))
    shown = parts.pop("shown", [1.0])
    keyframes = [SimpleNamespace(frame_index=8 * k) for k in range(len(shown))]
    return SimpleNamespace(
        mapper=SimpleNamespace(shown=shown, keyframes=keyframes),
        sequence=SimpleNamespace(warnings=[], camera=CAMERA, ground_truth=truth),
        lost_frames=lambda: [None] * lost,
        trajectory=lambda: Trajectory(np.arange(4) / 30, random_transforms(4, "normal", 1).numpy()),
        tracker=tracker,
        focal_length=parts.pop("focal_length", None),
        lens=parts.pop("lens", None),
        undone_lens=parts.pop("undone_lens", None),
    )


CAMERA = Camera(272.0, 272.0, 160.0, 120.0, 320, 240)
DOUBTFUL = FocalLengthFit(272.0, 1.1, 0.25)
ZOOMED = FocalLengthFit(272.0, 1.4, 0.52, half=(8, 15))
WARNINGS = [
    (
        {"lost": 1},
        "1 of 4 frames could not be tracked and have no pose; lost_frames.txt lists them",
    ),
    ({"lost": 2, "ends_lost": True}, "If the film is cut at frame 2, run the rest by itself"),
    ({"breaks": [Break(2, 2)]}, "broken at frames 2 to 2"),
    ({"breaks": [Break(2, 2)]}, "look at each piece (frames 0 to 1, 3 to 3) by itself"),
    (
        {"truth": [9.0, 9.5]},
        "there is no ATE: expected at least 3 timestamps of estimate and truth",
    ),
    ({"truth": [0.0]}, "found 1 (estimate 4 poses, 0.000 to 0.100 s, truth 1 pose, 0.000 to 0.000"),
    ({"truth": [0.0, 33.0, 67.0]}, "check that the times of both are in seconds: poses of the est"),
    ({"truth": [k / 30 for k in range(3)], "stands": True}, "or a camera that does not move"),
    ({"failed": 3}, "3 of 5 bundle adjustments failed"),
    ({"shown": [0.8, 0.4]}, "the map shows only 60% of what stands still, least in frame 8"),
    (
        {"lens": LensFit(300.0, (-0.1, 0.0), -0.07, 0.13)},
        "bends straight lines, the corners by -7%, with 13% less",
    ),
    (
        {"lens": LensFit(300.0, (0.0, 0.0), 0.01, 0.13), "focal_length": DOUBTFUL},
        "the flow fits 1.10 times the",
    ),
    (
        {"undone_lens": LensFit(300.0, (-0.1, 0.02), -0.07, 0.13)},
        "by -7%: the run begins anew on straightened images, k1 = -0.100, k2 = 0.020",
    ),
    ({"focal_length": DOUBTFUL}, "the flow fits 1.10 times the present focal length better"),
    ({"focal_length": ZOOMED}, "from frame 8 to 15 the flow fits 1.40 times the present focal"),
    ({"seeks_focal": True}, "the motion does not tell it"),
    ({"parallax": [0.1, 0.2, 5.0]}, "2 of 3 keyframes show hardly any parallax"),
    ({"parallax": [0.1], "knows_depth": False}, "and all that the map shows is at one depth"),
    ({"focal_length": DOUBTFUL}, "If the lens zoomed while it filmed, no focal length is right"),
    ({"overlay": torch.tensor([0.0, 1, 1, 1])}, "25% of the image stand still while the rest mov"),
    ({"has_prior": False}, "the unit of length is arbitrary"),
]


@pytest.mark.parametrize(("parts", "words"), WARNINGS)
def test_each_fault_is_one_warning(parts: dict, words: str):
    assert not list(facts._warnings(slam()))
    (warning,) = facts._warnings(slam(**parts))
    assert words in warning


def test_keyframes_without_depth_are_warned_of_where_a_prior_was_given():
    run = slam()
    run.tracker.keyframes = KeyframeStore(torch.zeros(2))
    for frame, depths in ((0, [0.5, 0.0]), (8, [0.0, 0.0]), (16, [0.0, 0.0])):
        row = SimpleNamespace(frame_index=frame), torch.zeros(1), None, torch.eye(4)
        run.tracker.keyframes.append(*row, torch.ones(2), torch.tensor(depths))
    assert not list(facts._warnings(run, "none"))
    (warning,) = facts._warnings(run, "files:made")
    assert "--depth files:made knows nothing of 2 of 3 keyframes, such as frame 8:" in warning


def test_a_truth_that_frames_match_is_not_warned_of():
    assert not list(facts._warnings(slam(truth=[k / 30 for k in range(3)])))


def test_without_an_ate_there_is_no_straight_walk(monkeypatch: pytest.MonkeyPatch):
    run, path = slam(), Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    run.trajectory = run.keyframe_trajectory = lambda: path
    run.tracker.grid, run.render = run.tracker.graph.grid, None
    monkeypatch.setattr(facts, "_ties", lambda run: {})
    monkeypatch.setattr(facts, "unseen_psnr", lambda run: None)
    for ate, line in ((None, None), (0.0, 86.0)):
        errors = {"ate_all_cm": ate, "ate_straight_line_cm": 86.0}
        monkeypatch.setattr(facts, "measure_run", lambda *_, found=errors: found)
        assert facts.measure(run, 1.0, None)["ate_straight_line_cm"] == line


def test_flow_that_is_hardly_more_than_a_turn_is_warned_of_where_no_prior_tells_depth():
    weak = {"beyond_turns": 0.9 * facts.LEAST_BEYOND_TURNS}
    assert not list(facts._warnings(slam(**weak)))
    warning, _ = facts._warnings(slam(**weak, has_prior=False))
    assert "only 0.41 px of the flow, in the median" in warning
    assert len(list(facts._warnings(slam(beyond_turns=None, has_prior=False)))) == 1
    warning, _ = facts._warnings(slam(**weak, has_prior=False, parallax=[0.1]))  # said once
    assert "hardly any parallax" in warning


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({}, "as given"),
        ({"seeks_focal": True, "focal_is_free": True}, "estimated from the motion, from 272.0"),
        ({"seeks_focal": True}, "the motion does not tell it"),
    ],
)
def test_the_focal_length_is_said_with_its_origin(parts: dict, words: str):
    run = slam(**parts)
    run.tracker.grid = run.tracker.graph.grid
    note = facts.focal_length_note(run)
    assert note.startswith("250.0 px for 320x240 images, ") and words in note


@pytest.mark.parametrize("broken", [{"lost": 1}, {"failed": 3}])
def test_a_broken_run_gives_no_advice_about_the_focal_length(broken: dict):
    (warning,) = facts._warnings(slam(focal_length=DOUBTFUL, **broken))
    assert "present focal length" not in warning


def test_the_visible_surface_has_the_mean_depth_and_a_gap_has_none():
    # Rendered depth is a sum over blending weights: 1.8 at an opacity of 0.9 is a surface at 2.
    depth, opacity = torch.tensor([[1.8, 0.4]]), torch.tensor([[0.9, 0.2]])
    rendering = Rendering(torch.zeros(1, 2, 3), depth, opacity, torch.ones(1))
    torch.testing.assert_close(facts.surface_depth(rendering), torch.tensor([[2.0, 0.0]]))


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
        keyframes=keyframes,
        camera=CAMERA,
        render=lambda pose: rendering._replace(color=color + 0.1 * pose),
        beta_of=lambda keyframe: keyframe.beta,
        static_weight=lambda beta, camera: beta,
    )
    uncertainty = SimpleNamespace(is_learnt=True)
    run = SimpleNamespace(mapper=mapper, config=SimpleNamespace(uncertainty=uncertainty))
    run.beta_image = lambda index: 0.5 + index
    first, second = facts.mapped_views(run)
    assert (first.frame_index, second.frame_index) == (8, 16)
    assert first.static_psnr == pytest.approx(20, abs=1e-3) and second.static_psnr is None
    assert first.color.max() == pytest.approx(0.4) and second.color.max() == pytest.approx(0.5)
    assert first.depth[0, 0] == 0 and first.depth[1, 1] == pytest.approx(2)
    assert (first.beta, second.beta) == (0.5, 1.5)
    uncertainty.is_learnt = False
    assert all(view.beta is None for view in facts.mapped_views(run))


def test_the_map_is_compared_with_some_frames_that_it_was_not_fitted_to():
    asked: list[int] = []

    def keyframes(first: int, others: list[int]) -> list[Keyframe]:
        assert first == 3  # none of the tracker
        asked[:] = others
        image, none = torch.full((4, 6, 3), 0.5), torch.zeros(4, 6)
        return [Keyframe(index, image, none, none, torch.tensor(index)) for index in others]

    def render(pose: torch.Tensor) -> Rendering:
        opacity = torch.ones(4, 6)
        return Rendering(torch.full((4, 6, 3), 0.2), opacity, opacity, torch.ones(1))

    mapper = SimpleNamespace(
        keyframes=[SimpleNamespace(frame_index=0)],
        exposures={0: torch.full((3,), 2.0)},  # so .4 is seen
        camera=CAMERA,
        render=render,
        beta_of=lambda keyframe: (torch.arange(6) < keyframe.frame_index).expand(4, 6),
        static_weight=lambda beta, camera: beta,
    )
    tracker = SimpleNamespace(keyframes=[None] * 3)
    run = SimpleNamespace(mapper=mapper, tracker=tracker, keyframes=keyframes)
    run.poses = dict.fromkeys(range(101))
    assert facts.unseen_psnr(run) == pytest.approx(20, abs=1e-3)
    assert len(asked) == facts.MOST_UNSEEN and asked[0] == 1 and asked[-1] == 96
    run.poses = dict.fromkeys(range(9))
    assert facts.unseen_psnr(run) is not None and asked == [1, 2, 3, 4, 5, 6, 7, 8]
    run.poses = {0: None}
    assert facts.unseen_psnr(run) is None


def test_a_film_that_goes_on_after_a_loss_is_not_called_cut():
    (warning,) = facts._warnings(slam(lost=1))
    assert "cut" not in warning
