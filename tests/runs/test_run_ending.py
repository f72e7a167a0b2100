"""How a run says that it ended: the state in run.json, and the exit code of README."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from minislam.config import SlamConfig
from minislam.runs.run import _ending
from minislam.uncertainty import UncertaintyConfig


def ended(
    lost: int = 0,
    unread: int = 0,
    failed: int = 0,
    broken: bool = False,
    shown: tuple[float, ...] = (1.0, 0.9),
    left_out: float = 0.6,
    **uncertainty: bool,
) -> object:
    graph = SimpleNamespace(adjustments=5, failed_adjustments=failed)
    tracker = SimpleNamespace(graph=graph, watch=SimpleNamespace(breaks=broken))
    sequence = SimpleNamespace(unread=[(0.1, "damaged")] * unread)
    mapper = SimpleNamespace(shown=shown, images=[None], camera=None, beta_of=lambda _: None)
    mapper.static_weight = lambda beta, camera: (torch.arange(100) >= 100 * left_out).float()
    config = replace(SlamConfig(), uncertainty=UncertaintyConfig(**uncertainty))
    parts = {"tracker": tracker, "sequence": sequence, "mapper": mapper, "config": config}
    return SimpleNamespace(**parts, lost_frames=lambda: [None] * lost)


@pytest.mark.parametrize(
    ("parts", "ending"),
    [
        ({}, ("finished", 0)),
        ({"failed": 2}, ("finished", 0)),
        ({"failed": 3}, ("finished, most bundle adjustments failed", 3)),
        ({"broken": True, "lost": 1}, ("finished, broken", 3)),
        ({"shown": (1.0, 0.4), "lost": 1}, ("finished, map with large holes", 3)),
        ({"shown": (1.0, 0.6)}, ("finished", 0)),
        ({"shown": (0.0, 0.0)}, ("finished, map with large holes", 3)),
        ({"shown": ()}, ("finished", 0)),
        ({"left_out": 0.8}, ("finished, map with large holes", 3)),
        ({"left_out": 0.8, "given_masks": True}, ("finished", 0)),
        ({"left_out": 0.8, "enabled": False}, ("finished", 0)),
        ({"lost": 1}, ("finished, partly lost", 3)),
        ({"unread": 1}, ("finished, images left out", 3)),
        ({"unread": 1, "lost": 1}, ("finished, partly lost", 3)),
    ],
)
def test_a_run_that_is_not_whole_ends_with_three(parts: dict, ending: tuple[str, int]):
    assert _ending(ended(**parts), interrupted=False) == ending


def test_an_interrupted_run_is_that_first_of_all():
    assert _ending(ended(lost=1), interrupted=True) == ("interrupted", 130)
