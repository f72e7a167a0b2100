"""State as a tree of plain values: what a type says is what is built again."""

from dataclasses import dataclass
from enum import Enum

import pytest
import torch
from torch import Tensor

from minislam.records import Frame
from minislam.state.stateful import Stateful, from_tree, to_tree


class Mood(Enum):
    CALM = "calm"


@dataclass(frozen=True)
class Note:
    mood: Mood
    values: Tensor
    weight: float | None


class Inner(Stateful):
    count: int = 0


class Outer(Stateful):
    inner: Inner
    notes: list[Note]
    source: torch.Generator

    def __init__(self) -> None:
        self.inner = Inner()
        self.notes = []
        self.source = torch.Generator().manual_seed(0)
        self.cache = "made again"


def frame(index: int) -> Frame:
    return Frame(index, 0.1 * index, torch.full((2, 2, 3), index / 10))


NOTE = Note(Mood.CALM, torch.arange(3.0), 0.1)
VALUES = [
    (int, 3),
    (float, 1 / 3),
    (str | None, None),
    (Mood, Mood.CALM),
    (list[Note | None], [NOTE, None]),
    (tuple[Frame, Note] | None, (frame(4), NOTE)),
    (dict[int, dict[str, Tensor]], {7: {"weights.0": torch.ones(2)}, 2: {}}),
]


@pytest.mark.parametrize(("kind", "value"), VALUES, ids=str)
def test_a_value_is_built_again_from_its_tree(kind: object, value: object):
    again = from_tree(kind, to_tree(value), frame)
    assert str(again) == str(value) and type(again) is type(value)


def test_a_tree_holds_frames_by_number_records_by_field_and_the_tensors_in_use():
    assert to_tree([frame(4), Mood.CALM]) == [4, "calm"]
    tree = to_tree(NOTE)
    assert list(tree) == ["mood", "values", "weight"] and tree["values"] is NOTE.values


def test_an_object_takes_up_the_state_of_another_and_its_parts_stay_the_same_objects():
    first, second = Outer(), Outer()
    first.inner.count, first.notes = 5, [NOTE]
    torch.rand(3, generator=first.source)
    inner, source = second.inner, second.source
    second.restore_state(first.saved_state(), frame)
    assert (second.inner, second.inner.count, second.source) == (inner, 5, source)
    assert "cache" not in first.saved_state()
    assert second.notes[0].mood is Mood.CALM
    draws = [torch.rand(4, generator=outer.source) for outer in (first, second)]
    assert torch.equal(*draws)
