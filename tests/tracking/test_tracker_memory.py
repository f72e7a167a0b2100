"""Between two keyframes nothing stays in memory: a longer clip does not need more of it."""

import gc
import tracemalloc
from dataclasses import replace

import pytest
import torch

from minislam.records import Frame
from tests.helpers import generator
from tests.tracking.recording import CONFIG, FRAMES, frames, new_tracker

pytestmark = pytest.mark.slow

HELD = (8, 32)  # frames after which memory is looked at, while the camera stands


def live_bytes() -> int:
    """Return the bytes of all tensors and of what numpy and Python hold."""
    gc.collect()
    tensors = [thing for thing in gc.get_objects() if type(thing) is torch.Tensor]
    storages = {t.untyped_storage().data_ptr(): t.untyped_storage().nbytes() for t in tensors}
    return sum(storages.values()) + tracemalloc.get_traced_memory()[0]


def test_memory_does_not_grow_with_the_frames_between_keyframes():
    images, source = frames(), generator(0)
    tracker = new_tracker(True, [*range(FRAMES), *[FRAMES - 1] * HELD[1]])
    for frame in images:
        tracker.track(frame)
        if not tracker.initialised and len(tracker.keyframes) == CONFIG.warmup_keyframes:
            tracker.initialise()
    tracker.graph.config = replace(CONFIG, keyframe_interval=10_000)  # none is forced
    found = []
    tracemalloc.start()
    for number in range(HELD[1] + 1):
        if number in HELD:
            found.append((live_bytes(), len(tracker.keyframes)))
        image = images[-1].image
        noise = 0.01 * torch.randn(image.shape, generator=source)
        index = FRAMES + number
        tracker.track(Frame(index, index / 30, (image + noise).clamp(0, 1)))
    tracemalloc.stop()
    (before, keyframes), (after, still) = found
    assert keyframes == still and all(t.status.is_followed for t in tracker.tracked[FRAMES:])
    assert after < 1.05 * before
