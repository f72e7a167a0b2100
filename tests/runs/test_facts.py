"""What a run tells about itself."""

import pytest

from minislam.runs import facts
from tests.runs.finished import finished


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({}, "as given"),
        ({"seeks_focal": True, "focal_is_free": True}, "estimated from the motion, from 272.0"),
        ({"seeks_focal": True}, "the motion does not tell it"),
        ({"seeks_focal": True, "has_begun": False}, "not sought yet"),
    ],
)
def test_the_focal_length_is_said_with_its_origin(parts: dict, words: str):
    run = finished(**{name: part for name, part in parts.items() if name != "has_begun"})
    run.tracker.grid, run.tracker.initialised = run.tracker.graph.grid, parts.get("has_begun", True)
    note = facts.focal_length_note(run)
    assert note.startswith("250.0 px for 320x240 images, ") and words in note
