"""A start that nothing can be matched with is lost; the frames after it are not."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from minislam.data.checkpoint import read_checkpoint, write_checkpoint
from minislam.errors import MinislamError
from minislam.priors.depth import NoDepth
from minislam.priors.interfaces import FlowMatches
from minislam.records import TrackingStatus
from minislam.tracking.config import TrackingConfig
from minislam.tracking.safeguards.first_frame import FirstFrame, has_warmed_up
from minislam.tracking.tracker import Tracker
from tests.helpers import generator
from tests.tracking.recording import frames, lost_frames, new_tracker, run
from tests.tracking.scene import CAMERA, STRIDE
from tests.tracking.test_tracker_losing import centres, renumbered
from tests.tracking.wall import GRID

PLACE_ERROR = 0.03  # of the length of the path; measured .004 to .006


def black(number: int) -> list[torch.Tensor]:
    return [torch.zeros_like(frames()[0].image)] * number


def slate(number: int) -> list[torch.Tensor]:
    """Return images of a title card: texture that has nothing to do with the scene."""
    noise = torch.rand(12, 16, 3, generator=generator(0))
    card = noise.repeat_interleave(10, 0).repeat_interleave(10, 1)
    return [card] * number


@pytest.mark.slow
@pytest.mark.parametrize(
    "start, lost", [(black(1), [0]), (black(3), [0, 1, 2]), (slate(3), [0, 1, 2])]
)
def test_an_unusable_start_is_lost_and_the_rest_is_followed(start, lost):
    images = [frame.image for frame in frames()[:18]]
    shown = [*[0] * len(start), *range(18)]
    tracker = new_tracker(with_depth=True, shown=shown)
    run(tracker, renumbered(start + images))
    assert lost_frames(tracker) == lost
    assert {tracker.tracked[index].reason for index in lost} == {"start given up"}
    assert tracker.keyframes.frames[0].frame_index == lost[-1] + 1
    estimate, truth = centres(tracker, shown)
    error = (torch.from_numpy(estimate - truth)).norm(dim=1).max()
    assert error < PLACE_ERROR * torch.from_numpy(truth).norm(dim=1).max()


@pytest.mark.slow
def test_where_nothing_can_be_matched_with_anything_the_run_ends_in_words():
    tracker = new_tracker(with_depth=True, shown=[0] * 6)
    with pytest.raises(MinislamError, match="found none among 6 frames"):
        run(tracker, renumbered(black(6)))


@pytest.mark.slow
def test_a_start_of_more_frames_than_are_lost_is_kept():
    images = [frame.image for frame in frames()]
    sequence = images[:4] + black(2) + images[4:14]
    tracker = new_tracker(with_depth=True, shown=[0, 1, 2, 3, 0, 0, *range(4, 14)])
    run(tracker, renumbered(sequence))
    assert lost_frames(tracker) == [4, 5]
    assert tracker.keyframes.frames[0].frame_index == 0


@pytest.mark.slow
@pytest.mark.parametrize("first, second", [(14, 24), (24, 14)])
def test_of_a_film_that_is_cut_after_the_warm_up_the_longer_part_is_kept(first: int, second: int):
    images = [frame.image for frame in frames()]
    film = images[:first] + [image.flip(1) for image in images[:second]]  # mirrored: another scene
    tracker = new_tracker(with_depth=False)
    tracker.graph.seeks_focal = True
    run(tracker, renumbered(film))
    assert tracker.graph.seeks_focal
    kept = range(first) if first > second else range(first, first + second)
    assert [t.frame_index for t in tracker.tracked if t.status.is_followed] == list(kept)
    assert len(tracker.watch.diagnostics) == len(tracker.keyframes)
    reason = "lost, matched ratio" if first > second else "start given up"
    assert all(reason in tracker.tracked[index].reason for index in lost_frames(tracker))


@pytest.mark.slow
def test_a_part_that_is_repeated_because_no_other_is_longer_is_as_it_was():
    poses = []
    for number in (5, 16):  # less, and more than are followed
        tracker = new_tracker(with_depth=False)
        run(tracker, renumbered([frame.image for frame in frames()[:14]] + black(number)))
        assert lost_frames(tracker) == list(range(14, 14 + number))
        poses.append(tracker.keyframes.T_camera_world)
    assert torch.equal(*poses)


@pytest.mark.parametrize("enough", [2, 6])
def test_the_warm_up_ends_with_its_last_keyframe(enough: int):
    for count in (enough - 1, enough):
        config, keyframes = TrackingConfig(warmup_keyframes=enough), [None] * count
        assert has_warmed_up(SimpleNamespace(config=config, keyframes=keyframes)) is (
            count == enough
        )


# Cuts between scenes, with a flow that only knows which scene an image shows, and where

BLACK, PACE = -1.0, 3.0  # no scene: nothing is matched with it; px per frame
NEVER = TrackingConfig(warmup_keyframes=99, keyframe_flow_without_prior=4 * PACE)


class SceneFlow:
    """Matches images of one scene, whole; they differ by a shift. Stands for its chains, too."""

    stride, learned_confidence = STRIDE, False

    def __init__(self, reference: Tensor | None = None, newest: Tensor | None = None) -> None:
        self._reference, self._newest, self.frames = reference, newest, set[int]()

    def add_frame(self, keyframe_index: int, image: Tensor) -> None:
        self.frames.add(keyframe_index)

    def remove_frame(self, keyframe_index: int) -> None:
        self.frames.remove(keyframe_index)

    def start_chain(self, image: Tensor) -> "SceneFlow":
        return SceneFlow(image, image)

    def restart(self) -> "SceneFlow":
        return SceneFlow(self._newest, self._newest)

    def advance(self, image: Tensor) -> tuple["SceneFlow", FlowMatches]:
        (scene, start, _), (shown, end, _) = self._reference[0, 0], image[0, 0]
        targets = GRID.pixels.T[None] + (end - start) * torch.tensor([[1.0], [0.0]])
        ratio = torch.tensor([float(scene == shown != BLACK)])
        return SceneFlow(self._reference, image), FlowMatches(targets, ratio + 0 * targets, ratio)


def shot(scene: float, count: int, pace: float = PACE) -> list[Tensor]:
    """Return images that say which scene they show, and where."""
    size = CAMERA.height, CAMERA.width, 1
    return [torch.tensor([scene, k * pace, 0.0]).repeat(size) for k in range(count)]


def followed_in(images: Sequence[Tensor]) -> tuple[list[int], Tracker, FirstFrame]:
    """Track images to their end; return which have poses, tracker and choice."""

    def static(keyframe: int) -> Tensor:
        return torch.ones(GRID.shape)

    flow, frames = SceneFlow(), renumbered(list(images))
    tracker = Tracker(CAMERA, NEVER, flow, lambda _: torch.ones(1, 1, 1), NoDepth(), static)
    first_frame = FirstFrame()
    for _ in range(20 * len(frames)):
        index = first_frame.next_frame(tracker, len(frames))
        if index is None:
            break
        assert index == len(tracker.tracked)
        tracker.track(frames[index])
    assert [frame.frame_index for frame in tracker.tracked] == list(range(len(frames)))
    assert flow.frames == set(range(len(tracker.keyframes)))
    assert len(tracker.graph.flow_to_next) == len(tracker.keyframes) - 1
    return [t.frame_index for t in tracker.tracked if t.status.is_followed], tracker, first_frame


@pytest.mark.parametrize("first, second", [(14, 14), (8, 20), (20, 8), (30, 30), (14, 13), (1, 2)])
def test_of_two_scenes_the_longer_is_kept(first: int, second: int):
    followed, tracker, _ = followed_in(shot(1, first) + shot(2, second))
    kept = range(first) if first > second else range(first, first + second)
    assert followed == list(kept)
    assert tracker.keyframes.frames[0].frame_index == kept[0]
    reasons = {"lost, matched ratio 0.000"} if first > second else {"start given up"}
    assert {t.reason for t in tracker.tracked if t.frame_index not in kept} <= reasons


def test_a_start_that_was_given_up_is_repeated_if_none_was_better():
    images = shot(1, 9) + shot(BLACK, 12) + shot(2, 4)
    followed, tracker, _ = followed_in(images)
    assert followed == list(range(9))
    statuses = {frame.status for frame in tracker.tracked[9:]}
    assert statuses == {TrackingStatus.LOST}


def test_frames_that_are_lost_after_the_choice_change_it_no_longer():
    images = shot(1, 20, pace=0.0)
    _, tracker, first = followed_in(images)
    for index in (17, 18, 19):
        tracker.tracked[index] = replace(tracker.tracked[index], status=TrackingStatus.LOST)
    assert first.next_frame(tracker, len(images)) is None and len(tracker.keyframes)


def test_without_a_depth_prior_a_title_that_stands_is_worth_less_than_a_scene_that_moves():
    title, scene = shot(1, 20, pace=0.0), shot(2, 6)
    assert followed_in(title + scene)[0] == list(range(20, 26))
    assert followed_in(scene + title)[0] == list(range(6))


def test_a_camera_that_stands_is_kept_where_nothing_better_comes():
    assert followed_in(shot(1, 8, pace=0.0) + shot(BLACK, 3))[0] == list(range(8))


def test_an_old_view_that_returns_is_followed_again():
    images = shot(1, 9)
    assert followed_in(images + shot(BLACK, 3) + images[6:])[0] == [*range(9), 12, 13, 14]


def test_an_interrupted_choice_goes_on(tmp_path: Path):
    given, restored = FirstFrame(), FirstFrame()
    given.best, given.worth, given.is_chosen = 7, (True, 9), True
    write_checkpoint(tmp_path / "a.npz", given.saved_state())
    restored.restore_state(read_checkpoint(tmp_path / "a.npz"), lambda index: None)
    assert vars(restored) == vars(given)


def test_a_choice_that_was_saved_between_two_starts_goes_on():
    shown = renumbered(black(1) + [frame.image for frame in frames()[:6]])
    tracker, first = new_tracker(with_depth=True, shown=[0, *range(6)]), FirstFrame()
    for _ in range(2):
        tracker.track(shown[first.next_frame(tracker, len(shown))])
    assert first.next_frame(tracker, len(shown)) == 1 and len(tracker.keyframes) == 0
    assert first.next_frame(tracker, len(shown)) == 1
