"""Input options: values that cannot be meant are refused."""

import math
from dataclasses import replace

import pytest

from minislam.data.options import FOCAL_BOUNDS, InputOptions
from minislam.errors import InputError
from minislam.geometry.camera import LONGEST_FOCAL
from minislam.tracking.safeguards.focal_column import MOST_ZOOM


@pytest.mark.parametrize(
    "field, value",
    [
        ("start", -1), ("stride", 0), ("max_frames", 0), ("size", (8, 240)), ("fx", float("nan")),
        ("depth_scale", 0.0), ("pixels", 0),
        ("size", (100_000, 100_000)), ("pixels", 10**10), ("fx", 1e300),
        ("fx", -1.0), ("fx", 0.0), ("fy", 5.01e4),
    ],
)  # fmt: skip
def test_impossible_options_are_refused(field: str, value: object):
    with pytest.raises(InputError, match="expected"):
        replace(InputOptions(), **{field: value})


def test_wrong_options_are_named():
    with pytest.raises(InputError, match=r"auto, found 'maybe'; choose one"):
        InputOptions(focal="maybe")
    with pytest.raises(InputError, match=r"expected fx of at least 1 and at most 50000, found -1"):
        InputOptions(fx=-1.0)


def test_the_longest_focal_length_may_still_be_refined():
    longest = FOCAL_BOUNDS[1]
    assert InputOptions(fx=longest, fy=longest).fx == longest
    assert longest * math.exp(MOST_ZOOM) <= LONGEST_FOCAL * (1 + 1e-9)
