"""A rolling shutter is found where the flow tells it, and nowhere else."""

from dataclasses import replace

import pytest

from minislam.evaluation import absolute_trajectory_error
from tests.benchmarks.bench_phone import NONE, filmed, follow, truth

pytestmark = pytest.mark.slow


def test_a_phone_is_followed_as_if_it_had_a_global_shutter():
    # Upright, so columns are read. Measured: 19.4 ms, 0.36 cm; with the readouts held 3.7 cm.
    estimate, _, readout = follow(filmed("ball", 7, replace(NONE, readout=0.02)), False)
    assert readout[0] == pytest.approx(0.02, abs=0.002)
    assert readout[1] == 0, "a sensor is read along one axis"
    error = absolute_trajectory_error(estimate, truth("ball", 7)).statistics["rmse"]
    assert error < 0.006


def test_a_global_shutter_has_no_readout():
    assert follow(filmed("ball", 7, NONE), False)[2] == (0.0, 0.0)


def test_nothing_is_sought_where_it_is_switched_off():
    frames = filmed("ball", 7, replace(NONE, readout=0.02))[:20]
    assert follow(frames, False, rolling=False)[2] == (0.0, 0.0)
