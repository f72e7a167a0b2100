"""A start that nothing can be matched with is lost; the frames after it are not."""

import pytest
import torch

from minislam.errors import TrackingLost
from minislam.records import TrackingStatus
from tests.helpers import generator
from tests.tracking.recording import frames, lost_frames, new_tracker, run
from tests.tracking.test_tracker_losing import centres, renumbered

pytestmark = pytest.mark.slow

PLACE_ERROR = 0.03  # of the length of the path; measured .004 to .006


def black(number: int) -> list[torch.Tensor]:
    return [torch.zeros_like(frames()[0].image)] * number


def slate(number: int) -> list[torch.Tensor]:
    """Return images of a title card: texture that has nothing to do with the scene."""
    noise = torch.rand(12, 16, 3, generator=generator(0))
    card = noise.repeat_interleave(10, 0).repeat_interleave(10, 1)
    return [card] * number


@pytest.mark.parametrize(
    "start, lost", [(black(1), [0]), (black(3), [0, 1, 2]), (slate(3), [0, 1, 2, 3, 4])]
)
def test_an_unusable_start_is_lost_and_the_rest_is_followed(start, lost):
    images = [frame.image for frame in frames()[:18]]
    shown = [*[0] * len(start), *range(18)]
    tracker = new_tracker(with_depth=True, shown=shown)
    run(tracker, renumbered(start + images))
    assert lost_frames(tracker) == lost
    assert {tracker.tracked[index].status for index in lost} == {TrackingStatus.LOST}
    assert tracker.keyframes.frames[0].frame_index == lost[-1] + 1
    estimate, truth = centres(tracker, shown)
    error = (torch.from_numpy(estimate - truth)).norm(dim=1).max()
    assert error < PLACE_ERROR * torch.from_numpy(truth).norm(dim=1).max()


def test_where_nothing_can_be_matched_with_anything_the_run_ends_in_words():
    tracker = new_tracker(with_depth=True, shown=[0] * 6)
    with pytest.raises(TrackingLost, match="found none among 6 frames"):
        run(tracker, renumbered(black(6)))


def test_a_start_of_more_frames_than_are_lost_is_kept():
    images = [frame.image for frame in frames()]
    sequence = images[:4] + black(2) + images[4:14]
    tracker = new_tracker(with_depth=True, shown=[0, 1, 2, 3, 0, 0, *range(4, 14)])
    run(tracker, renumbered(sequence))
    assert lost_frames(tracker) == [4, 5]
    assert tracker.keyframes.frames[0].frame_index == 0
