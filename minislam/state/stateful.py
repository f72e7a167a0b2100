"""What a run needs to go on later: the state of its parts, as a tree of plain values.

A class with state names the attributes that make it up. What follows from the settings and the
sequence alone (cameras, images, caches) is not among them: it is made again.
"""

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from enum import Enum
from types import NoneType, UnionType
from typing import Any, ClassVar, get_args, get_origin, get_type_hints

import torch

from minislam.records import Frame

# Dictionaries (keys are text) and lists of tensors, arrays, numbers, text and None.
Tree = Any
FrameOf = Callable[[int], Frame]  # reads a frame again, by its frame_index


class Stateful:
    """A thing that can tell its state, and take it up again where another process left off."""

    STATE: ClassVar[dict[str, Any]] = {}  # attribute -> its type, which says how to build it again

    def saved_state(self) -> Tree:
        """Return the state. Tensors are those in use: write them before anything moves on."""
        return {name: saved(getattr(self, name)) for name in self.STATE}

    def restore_state(self, state: Tree, frame_of: FrameOf) -> None:
        """Take up a saved state; nothing of the present one is left."""
        for name, kind in self.STATE.items():
            present = getattr(self, name)
            if isinstance(present, Stateful):
                present.restore_state(state[name], frame_of)
            elif isinstance(present, torch.Generator):
                present.set_state(state[name])
            else:
                setattr(self, name, built(kind, state[name], frame_of))


def saved(value: Any) -> Tree:
    """Return a value as a tree; of a frame only its index, of records only their fields."""
    if hasattr(value, "saved_state"):
        return value.saved_state()
    if isinstance(value, Frame):
        return value.frame_index
    if isinstance(value, torch.Generator):
        return value.get_state()
    if isinstance(value, Enum):
        return value.value
    if is_dataclass(value):
        return {field.name: saved(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, dict):
        return {str(key): saved(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [saved(item) for item in value]
    return value


def built(kind: Any, tree: Tree, frame_of: FrameOf) -> Any:
    """Return the value of a type, like `list[Frame] | None`, from its tree."""
    if tree is None:
        return None
    origin, inside = get_origin(kind), get_args(kind)
    if origin is UnionType:
        kind = next(part for part in inside if part is not NoneType)
        return built(kind, tree, frame_of)
    if origin is list:
        return [built(inside[0], item, frame_of) for item in tree]
    if origin is tuple:
        return tuple(built(part, item, frame_of) for part, item in zip(inside, tree, strict=True))
    if origin is dict:
        return {inside[0](key): built(inside[1], item, frame_of) for key, item in tree.items()}
    if kind is Frame:
        return frame_of(tree)
    if hasattr(kind, "restored"):  # it makes itself
        return kind.restored(tree, frame_of)
    if is_dataclass(kind):
        hints = get_type_hints(kind)
        return kind(**{name: built(hints[name], tree[name], frame_of) for name in hints})
    return kind(tree) if issubclass(kind, Enum) else tree
