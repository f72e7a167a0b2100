"""Input options: values that cannot be meant are refused."""

from dataclasses import replace

import pytest

from minislam.data.options import InputOptions
from minislam.errors import InputError


@pytest.mark.parametrize(
    "field, value",
    [
        ("start", -1), ("stride", 0), ("max_frames", 0), ("size", (8, 240)), ("fx", float("nan")),
        ("depth_scale", 0.0), ("pixels", 0),
        ("size", (100_000, 100_000)), ("pixels", 10**10), ("fx", 1e300),
    ],
)  # fmt: skip
def test_impossible_options_are_refused(field: str, value: object):
    with pytest.raises(InputError, match="expected"):
        replace(InputOptions(), **{field: value})
