"""The form of a setting: a dataclass field with a default and a meaning."""

from dataclasses import field
from typing import Any


def parameter(default: Any, meaning: str) -> Any:
    """Return a dataclass field whose meaning (symbol, unit, source) is also its help text."""
    return field(default=default, metadata={"meaning": meaning})
