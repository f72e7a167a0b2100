"""Input options: values that cannot be meant are refused."""

from dataclasses import replace

import pytest

from minislam.data.options import InputOptions
from minislam.errors import InputError
from minislam.geometry.camera import LONGEST_FOCAL


@pytest.mark.parametrize(
    "field, value",
    [
        ("start", -1), ("stride", 0), ("max_frames", 0), ("size", (8, 240)), ("fx", float("nan")),
        ("depth_scale", 0.0), ("pixels", 0),
        ("size", (100_000, 100_000)), ("pixels", 10**10), ("fx", 1e300),
        ("fx", -1.0), ("fx", 0.0), ("fy", 1.01e6),
    ],
)  # fmt: skip
def test_impossible_options_are_refused(field: str, value: object):
    with pytest.raises(InputError, match="expected"):
        replace(InputOptions(), **{field: value})


def test_the_bounds_of_a_focal_length_are_those_of_a_camera():
    assert InputOptions(fx=LONGEST_FOCAL, fy=LONGEST_FOCAL).fx == LONGEST_FOCAL
    with pytest.raises(InputError, match=r"auto, found 'maybe'; choose one"):
        InputOptions(focal="maybe")
    with pytest.raises(InputError, match=r"expected fx of at least 1 and at most 1e\+06, found -1"):
        InputOptions(fx=-1.0)
