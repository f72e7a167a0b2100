"""The state of a run as a tree of plain values, from which another process can go on.

The state of a `Stateful` class is what its body annotates:

    class Mapper(Stateful):
        window: list[int]  # saved and restored
        _optimizer: MapOptimizer  # a Stateful part: saved and restored by itself

Attributes that only `__init__` sets, like callbacks and caches, follow from settings and input.
"""

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
import torch

from minislam.records import Frame

# Dictionaries (keys are text) and lists of tensors, arrays, numbers, text and None.
Tree = Any
hints_of = cache(get_type_hints)
FrameOf = Callable[[int], Frame]  # reads a frame again, by its frame_index


class Stateful:
    """An object whose state can be saved, and restored in another process."""

    def saved_state(self) -> Tree:
        """Return the state. Its tensors are those in use: write them before the next step."""
        return {name: to_tree(getattr(self, name)) for name in get_type_hints(type(self))}

    def restore_state(self, state: Tree, frame_of: FrameOf) -> None:
        """Replace the present state by a saved one."""
        # Stateful parts and random generators stay the same objects, since others may hold them.
        for name, kind in get_type_hints(type(self)).items():
            present = getattr(self, name)
            if isinstance(present, Stateful):
                present.restore_state(state[name], frame_of)
            elif isinstance(present, torch.Generator):
                present.set_state(state[name])
            else:
                setattr(self, name, from_tree(kind, state[name], frame_of))


def to_tree(value: Any) -> Tree:
    """Return a value as a tree; a frame becomes its index, a record its fields."""
    if hasattr(value, "saved_state"):
        return value.saved_state()
    if isinstance(value, Frame):
        return value.frame_index
    if isinstance(value, torch.Generator):
        return value.get_state()
    if isinstance(value, Enum):
        return value.value
    if is_dataclass(value):
        return {field.name: to_tree(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, dict):
        return {str(key): to_tree(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_tree(item) for item in value]
    return value


def from_tree(kind: Any, tree: Tree, frame_of: FrameOf) -> Any:
    """Return the value of a type, like `list[Frame] | None`, from its tree."""
    if tree is None:
        return None
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is UnionType:
        return from_tree(arguments[0], tree, frame_of)  # of a kind | None
    if origin is list:
        return [from_tree(arguments[0], item, frame_of) for item in tree]
    if origin is tuple:
        parts = zip(arguments, tree, strict=True)
        return tuple(from_tree(part, item, frame_of) for part, item in parts)
    if origin is dict:
        of_key, of_value = arguments
        return {of_key(key): from_tree(of_value, item, frame_of) for key, item in tree.items()}
    if kind is Frame:
        return frame_of(tree)
    if kind is np.ndarray:
        return np.asarray(tree)  # a pipe to another process carries tensors
    if isinstance(kind, type) and is_dataclass(kind):
        hints = hints_of(kind)
        return kind(**{name: from_tree(hints[name], tree[name], frame_of) for name in hints})
    return kind(tree) if issubclass(kind, Enum) else tree
