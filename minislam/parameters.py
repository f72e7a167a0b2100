"""The form of a setting: a dataclass field with a default, a meaning and bounds.

Settings stand in trees of dataclasses; names with dots reach every part of one: `tracking.window`.
"""

import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import Field, field, fields, is_dataclass, replace
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, get_args, get_origin

from minislam.errors import InputError, nearest, require

Tree = TypeVar("Tree")  # a dataclass whose fields are values or again dataclasses

FILES = "files:"  # before the name of a folder with one file per frame
MOST = 1e9  # no setting of the package is larger, where it does not say so


def parameter(default: Any, meaning: str, least: float = 0, most: float = MOST) -> Any:
    """Return a dataclass field; its meaning (symbol, unit, source) is also its help text."""
    return field(default=default, metadata={"meaning": meaning, "least": least, "most": most})


def require_bounds(name: str, value: Any, least: float, most: float) -> None:
    """Refuse a number, or a tuple of numbers, out of bounds; anything else passes."""
    for number in value if isinstance(value, tuple) else (value,):
        is_within = not isinstance(number, int | float) or least <= number <= most
        wanted = f"{name} of at least {least:g} and at most {most:g}"
        require(is_within, wanted, f"{value}; choose a value between")


def user_path(path: Path | str) -> Path:
    """Return a path with ~ as the home of the user; a home that nobody has is left as it is."""
    return Path(os.path.expanduser(path))


def absolute_path(name: str) -> str:
    """Return a path, or files:FOLDER, made absolute: it holds in any working folder."""
    return FILES * name.startswith(FILES) + str(user_path(name.removeprefix(FILES)).absolute())


def leaves(tree: Any, prefix: str = "") -> Iterator[tuple[str, Any, Field[Any]]]:
    """Yield the name with dots, the value and the field of every value in a tree."""
    for entry in fields(tree):
        value = getattr(tree, entry.name)
        if is_dataclass(value):
            yield from leaves(value, f"{prefix}{entry.name}.")
        else:
            yield prefix + entry.name, value, entry


def kind_of(entry: Field[Any]) -> Any:
    """Return the type of a field's values that are not None, like int or tuple[int, int]."""
    return get_args(entry.type)[0] if isinstance(entry.type, UnionType) else entry.type


def with_values(tree: Tree, values: Mapping[str, Any]) -> Tree:
    """Return a tree with values replaced; they are given by name, as in JSON or as text."""
    known = [name for name, *_ in leaves(tree)]
    for name, value in values.items():
        is_empty_part = value == {} and any(other.startswith(f"{name}.") for other in known)
        if name not in known and not is_empty_part:
            hint = nearest(name, known, "minislam settings lists all of them")
            raise InputError(f"expected a known setting, found {name!r}; {hint}")
    return _replaced(tree, values)


def _replaced(tree: Any, values: Mapping[str, Any], prefix: str = "") -> Any:
    changed = {}
    for entry in fields(tree):
        name, present = prefix + entry.name, getattr(tree, entry.name)
        if is_dataclass(present):
            changed[entry.name] = _replaced(present, values, f"{name}.")
        elif name in values:
            value = _converted(name, values[name], present, entry)
            bounds = entry.metadata.get("least", 0), entry.metadata.get("most", MOST)
            require_bounds(name, value, *bounds)
            changed[entry.name] = value
    return replace(tree, **changed)


def _converted(name: str, value: Any, present: Any, entry: Field[Any]) -> Any:
    """Convert a value from JSON or from the command line to the type of its field."""
    kind = kind_of(entry)
    if value is None and kind is not entry.type:
        return None
    try:
        if get_origin(kind) is not tuple:
            return _plain(kind, value)
        parts = value.strip("()[] ").split(",") if isinstance(value, str) else value
        return tuple(_plain(of, part) for of, part in zip(get_args(kind), parts, strict=True))
    except (KeyError, OverflowError, TypeError, ValueError):
        wanted = "a finite number" if kind is float else f"of type {kind.__name__}"
        like = "" if present is None else f" like {present!r}"
        advice = f"; write {name}=(320, 240)" * (present is None and get_origin(kind) is tuple)
        raise InputError(f"expected {name} to be {wanted}{like}, found {value!r}{advice}") from None


def _plain(kind: Any, value: Any) -> Any:
    """Convert a value to bool, int, float or str; raises what `_converted` knows."""
    if kind is bool:
        words = {"true": True, "false": False, "1": True, "0": False, "on": True, "off": False}
        return value if isinstance(value, bool) else words[str(value).lower()]
    converted = kind(value)
    # int(2.5) and float("nan") succeed, but are always mistakes.
    is_wrong = isinstance(value, bool) or (kind is not str and not math.isfinite(converted))
    if is_wrong or (not isinstance(value, str) and converted != value):
        raise ValueError
    return converted


def flattened(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Return nested dictionaries as a single one, with names that contain dots."""
    like = '{"tracking": {"window": 8}} or {"tracking.window": 8}'
    found = f"{type(tree).__name__}; write {like}"
    require(isinstance(tree, dict), "settings as a JSON object", found)
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, dict) and value:
            flat |= flattened(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat
