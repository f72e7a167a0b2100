"""The form of a setting: a dataclass field with a default, a meaning and bounds."""

from dataclasses import field
from typing import Any

from minislam.errors import InputError

MOST = 1e9  # no setting of the package is larger, where it does not say so


def parameter(default: Any, meaning: str, least: float = 0, most: float = MOST) -> Any:
    """Return a dataclass field; its meaning (symbol, unit, source) is also its help text."""
    return field(default=default, metadata={"meaning": meaning, "least": least, "most": most})


def require_bounds(name: str, value: Any, least: float, most: float) -> None:
    """Refuse a number, or a tuple of numbers, out of bounds; anything else passes."""
    for number in value if isinstance(value, tuple) else (value,):
        if isinstance(number, int | float) and not least <= number <= most:
            raise InputError(
                f"expected {name} of at least {least:g} and at most {most:g}, found {value}; "
                "choose a value between"
            )
